"""Reading a result folder back, with the true ids of its regions."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import BaseModel
from torch import Tensor

from mvseg.errors import InputError
from mvseg.evaluation.truth import shown_instance
from mvseg.formats.coco import Rle, decode_rle
from mvseg.formats.image_file import file_name_problem
from mvseg.formats.json_file import Int64, Items, Pixels, read_json
from mvseg.formats.label_png import read_label_png


class _Image(BaseModel):
    id: int
    name: str
    width: Pixels
    height: Pixels


class _Instance(BaseModel):
    image_id: int
    instance_id: Int64
    segmentation: Rle


class _Instances(BaseModel):
    images: Items[_Image]
    annotations: Items[_Instance]


def find_result(folder: Path) -> Path:
    """The result folder that a path means: itself, or the only result in it (`mvseg match` writes one per scene).

    Raises:
        InputError: it holds several results.
    """
    if (folder / "instances.json").is_file() or not folder.is_dir():
        return folder
    inside = sorted(path.parent for path in folder.glob("*/instances.json"))
    if len(inside) > 1:
        names = ", ".join(path.name for path in inside[:3]) + (", ..." if len(inside) > 3 else "")
        raise InputError(f"{folder}: holds {len(inside)} results ({names}), expected one of them: {inside[0]}")
    return inside[0] if inside else folder


def read_instances(folder: Path, truth: Path) -> tuple[Tensor, Tensor]:
    """Estimated and true instance ids of the regions of a result.

    Args:
        folder: a result folder.
        truth: a folder of label PNGs, one per view, the same number for the same instance in every view.

    Returns:
        (D,) int64 ids as in instances.json (-1 = matched to nothing) and (D,) int64 true labels: 0 for a region that
        mostly covers no instance, 65535 for one that is mostly ignored.

    Raises:
        InputError: the result or the truth is missing or broken.
    """
    path = folder / "instances.json"
    if not path.is_file():
        raise InputError(f"{path}: is missing, expected a result folder")
    if not truth.is_dir():
        raise InputError(f"{truth}: no such folder of true labels")
    content = read_json(path, _Instances)
    for image in content.images:
        problem = file_name_problem(image.name, folder="the folder of true labels")
        if problem:
            raise InputError(f"{path}: image {image.name}: {problem}")
    images = {image.id: image for image in content.images}
    labels = {
        number: read_label_png(truth / f"{image.name}.png", image.width, image.height)
        for number, image in images.items()
    }
    true = []
    for index, annotation in enumerate(content.annotations):
        if annotation.image_id not in images:
            raise InputError(f"{path}: annotations[{index}]: there is no image {annotation.image_id}")
        image = images[annotation.image_id]
        try:
            mask = decode_rle(annotation.segmentation.counts, image.width, image.height)
        except InputError as error:
            raise InputError(f"{path}: annotations[{index}]: {error}") from None
        true.append(shown_instance(labels[image.id], mask))
    ids = [annotation.instance_id for annotation in content.annotations]
    return torch.tensor(ids, dtype=torch.int64), torch.tensor(true, dtype=torch.int64)
