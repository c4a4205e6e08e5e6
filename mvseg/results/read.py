"""Reading a result folder back, with the true labels of its views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.coco import Rle, decode_rle
from mvseg.formats.image_file import file_name_problem
from mvseg.formats.json_file import Int64, Items, Pixels, read_json
from mvseg.formats.label_png import read_label_png
from mvseg.regions import Regions, mask_box, stack_regions


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


def read_instances(folder: Path, truth: Path) -> tuple[Regions, list[np.ndarray]]:
    """The masks and ids of a result, and the true labels of its views.

    Args:
        folder: a result folder.
        truth: a folder of label PNGs, one per view, the same number for the same instance in every view.

    Returns:
        D regions in the frames of the photos, whose `labels` are the ids of instances.json (-1 = matched to nothing),
        and V true label maps.

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
    view_of = {number: view for view, number in enumerate(images)}
    labels = [read_label_png(truth / f"{image.name}.png", image.width, image.height) for image in images.values()]
    views, boxes, crops = [], [], []
    for index, annotation in enumerate(content.annotations):
        if annotation.image_id not in images:
            raise InputError(f"{path}: annotations[{index}]: there is no image {annotation.image_id}")
        image = images[annotation.image_id]
        try:
            mask = torch.from_numpy(decode_rle(annotation.segmentation.counts, image.width, image.height))
        except InputError as error:
            raise InputError(f"{path}: annotations[{index}]: {error}") from None
        views.append(view_of[annotation.image_id])
        boxes.append(mask_box(mask) if mask.any() else (0, 0, 1, 1))
        x1, y1, x2, y2 = boxes[-1]
        crops.append(mask[y1:y2, x1:x2].flatten().bool())
    ids = [annotation.instance_id for annotation in content.annotations]
    return stack_regions(views, boxes, crops, labels=ids, num_views=len(labels)), labels
