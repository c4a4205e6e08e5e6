"""COCO instance JSON: masks in (compressed RLE, uncompressed RLE, polygons), instances with their ids out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.scene import Scene


class _Image(BaseModel):
    id: int
    file_name: str
    width: int
    height: int


class _Annotation(BaseModel):
    id: int
    image_id: int
    segmentation: list[list[float]] | dict[str, Any]
    iscrowd: int = 0
    instance_id: int | None = None


class _Coco(BaseModel):
    images: list[_Image]
    annotations: list[_Annotation]


def read_coco(path: Path, scene: Scene) -> list[list[tuple[int, np.ndarray]]]:
    """The masks of a COCO file, view by view, as they stand there (in the frame of the photo).

    Images are found by file name: the view's photo path, or its name with or without suffix. Crowds are left out;
    images that are not in the scene too.

    Returns:
        V lists of (annotation id, (height, width) bool mask); a view without annotations has an empty list.

    Raises:
        InputError: the file is broken, a view has no image entry, an entry is of another size than its camera says, or
            a segmentation cannot be decoded.
    """
    coco = read_json(path, _Coco)
    masks: list[list[tuple[int, np.ndarray]]] = []
    for index, view in enumerate(scene.views):
        entries = [image for image in coco.images if _is_photo(image.file_name, view.name, view.path)]
        if not entries:
            raise InputError(f"{path}: view {index} ({view.name}) has no entry among the images")
        size = tuple(scene.cameras.sizes[index].tolist())
        ids = {image.id for image in entries}
        for image in entries:
            if (image.width, image.height) != size:
                raise InputError(
                    f"{path}: image {image.file_name} is {image.width} x {image.height}, "
                    f"its camera says {size[0]} x {size[1]}"
                )
        found = [one for one in coco.annotations if one.image_id in ids and not one.iscrowd]
        masks.append([(one.id, _decode(path, one, size[0], size[1])) for one in found])
    return masks


def _is_photo(file_name: str, name: str, photo: Path) -> bool:
    plain = file_name.replace("\\", "/").removeprefix("./")
    return photo.as_posix().endswith("/" + plain) or plain == name or plain.rsplit(".", 1)[0] == name


def _decode(path: Path, annotation: _Annotation, width: int, height: int) -> np.ndarray:
    segmentation = annotation.segmentation
    try:
        if isinstance(segmentation, list):
            rle = coco_mask.merge(coco_mask.frPyObjects(segmentation, height, width))
        elif isinstance(segmentation["counts"], list):
            rle = coco_mask.frPyObjects(segmentation, height, width)
        else:
            rle = segmentation
        mask = coco_mask.decode(rle)
    except Exception as error:  # pycocotools raises bare Exceptions, TypeErrors, KeyErrors and ValueErrors
        raise InputError(f"{path}: annotation {annotation.id}: cannot decode its segmentation ({error})") from None
    if mask.shape != (height, width):
        size = f"{mask.shape[1]} x {mask.shape[0]}"
        raise InputError(f"{path}: annotation {annotation.id}: its mask is {size}, its camera says {width} x {height}")
    return mask.astype(bool)


def encode_mask(mask: np.ndarray) -> dict[str, Any]:
    """(H, W) bool -> COCO compressed RLE that json can write."""
    rle = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(side) for side in rle["size"]], "counts": rle["counts"].decode("ascii")}


def write_coco(path: Path, images: list[dict[str, Any]], annotations: list[dict[str, Any]]) -> None:
    """Write a COCO file of one category, "instance"; annotations carry "segmentation" (RLE) and their own keys."""
    for number, annotation in enumerate(annotations, start=1):
        rle = annotation["segmentation"]
        annotation |= {"id": number, "category_id": 1, "iscrowd": 0}
        annotation |= {"area": int(coco_mask.area(rle)), "bbox": coco_mask.toBbox(rle).tolist()}
    content = {"images": images, "categories": [{"id": 1, "name": "instance"}], "annotations": annotations}
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")
