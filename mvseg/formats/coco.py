"""COCO instance JSON: masks in (compressed RLE, uncompressed RLE, polygons), instances with their ids out."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import BaseModel, FiniteFloat, NonNegativeInt

from mvseg.errors import InputError, InputWarning
from mvseg.formats.json_file import read_json
from mvseg.scene import Scene


class _Image(BaseModel):
    id: int
    file_name: str
    width: int
    height: int


class Rle(BaseModel):
    """A run-length encoded mask as it stands in the file; size is (height, width)."""

    size: tuple[int, int]
    counts: str | list[NonNegativeInt]


class _Annotation(BaseModel):
    id: int
    image_id: int
    segmentation: list[list[FiniteFloat]] | Rle
    iscrowd: int = 0


class _Coco(BaseModel):
    images: list[_Image]
    annotations: list[_Annotation]


def read_coco(path: Path, scene: Scene) -> list[list[tuple[int, np.ndarray]]]:
    """The masks of a COCO file, view by view, as they stand there (in the frame of the photo).

    Images are found by file name: the view's photo path, or its name with or without suffix; a shorter path will do
    when it is that of one view only. Crowds are left out; images that are not in the scene too.

    Returns:
        V lists of (annotation id, (height, width) bool mask); a view without annotations has an empty list.

    Raises:
        InputError: the file is broken, a view has no image entry, an entry could be of several views or is of another
            size than its camera says, or a segmentation cannot be decoded.
    """
    coco = read_json(path, _Coco)
    masks: list[list[tuple[int, np.ndarray]]] = []
    numbers = {image.id for image in coco.images}
    lost = [one.id for one in coco.annotations if one.image_id not in numbers]
    if lost:
        message = f"{path}: {len(lost)} annotations are of no image in the file, the first is annotation {lost[0]}"
        warnings.warn(message, InputWarning, stacklevel=4)
    view_of = [_find_view(path, image.file_name, scene) for image in coco.images]
    for index, view in enumerate(scene.views):
        entries = [image for image, one in zip(coco.images, view_of, strict=True) if one == index]
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


def _find_view(path: Path, file_name: str, scene: Scene) -> int | None:
    plain = file_name.replace("\\", "/").removeprefix("./")
    named = [i for i, view in enumerate(scene.views) if view.name in (plain, plain.rsplit(".", 1)[0])]
    found = named or [i for i, view in enumerate(scene.views) if f"/{view.path.as_posix()}".endswith("/" + plain)]
    if len(found) > 1:
        views = " or ".join(f"{i} ({scene.views[i].name})" for i in found)
        raise InputError(f"{path}: image {file_name} could be view {views}, expected its path")
    return found[0] if found else None


def _decode(path: Path, annotation: _Annotation, width: int, height: int) -> np.ndarray:
    segmentation = annotation.segmentation
    try:
        if isinstance(segmentation, list):
            return _decode_polygons(segmentation, width, height)
        if segmentation.size != (height, width):
            size = f"{segmentation.size[1]} x {segmentation.size[0]}"
            raise InputError(f"its mask is {size}, its camera says {width} x {height}")
        return decode_rle(segmentation.counts, width, height)
    except InputError as error:
        raise InputError(f"{path}: annotation {annotation.id}: {error}") from None


def _decode_polygons(polygons: list[list[float]], width: int, height: int) -> np.ndarray:
    """pycocotools walks along every edge pixel by pixel, so a corner far away would ask for memory without end."""
    if not polygons or any(len(polygon) < 6 or len(polygon) % 2 for polygon in polygons):
        raise InputError("expected polygons x1, y1, x2, y2, x3, y3 and so on")
    if max(abs(side) for polygon in polygons for side in polygon) > 10 * max(width, height):
        raise InputError("a polygon leads far out of the image")
    rle = coco_mask.merge(coco_mask.frPyObjects(polygons, height, width))
    return decode_rle(rle["counts"].decode("ascii"), width, height)


def decode_rle(counts: str | list[int], width: int, height: int) -> np.ndarray:
    """(height, width) bool from the counts of a COCO RLE, compressed or not: run lengths down the columns, 0 first.

    pycocotools fills what too short counts leave open with whatever the memory holds; here that is an error.

    Raises:
        InputError: the counts do not add up to the image.
    """
    runs = _decompress(counts) if isinstance(counts, str) else counts
    if min(runs, default=0) < 0 or sum(runs) != width * height:
        raise InputError(f"its run lengths do not add up to {width} x {height} pixels")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def _decompress(counts: str) -> list[int]:
    """Run lengths from COCO's string: 5 bits a character, least first, bit 6 = more follow; from the third run on, the
    difference to the run before the last."""
    runs: list[int] = []
    number = shift = 0
    for character in counts:
        bits = ord(character) - 48
        number |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            number -= (1 << shift) if bits & 0x10 else 0  # the sign
            runs.append(number + (runs[-2] if len(runs) > 2 else 0))
            number = shift = 0
    return runs


def encode_mask(mask: np.ndarray) -> dict[str, Any]:
    """(H, W) bool -> COCO compressed RLE that json can write."""
    rle = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(side) for side in rle["size"]], "counts": rle["counts"].decode("ascii")}


def write_coco(
    path: Path, images: list[dict[str, Any]], annotations: list[dict[str, Any]], *, category: str = "instance"
) -> None:
    """Write a COCO file of one category; annotations carry "segmentation" (RLE) and their own keys."""
    for number, annotation in enumerate(annotations, start=1):
        rle = annotation["segmentation"]
        annotation |= {"id": number, "category_id": 1, "iscrowd": 0}
        annotation |= {"area": int(coco_mask.area(rle)), "bbox": coco_mask.toBbox(rle).tolist()}
    content = {"images": images, "categories": [{"id": 1, "name": category}], "annotations": annotations}
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")
