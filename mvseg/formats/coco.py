"""COCO instance JSON: masks in (polygons, run lengths, compressed run lengths), instances with their ids out.

The only codec of COCO's masks: whatever a file says, a mask of the image's size comes out, or one sentence.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import BaseModel, FiniteFloat, NonNegativeInt, TypeAdapter, ValidationError

from mvseg.errors import InputError, InputWarning
from mvseg.formats.json_file import read_json
from mvseg.scene import Scene


class CocoImage(BaseModel):
    """An image as it stands in the file."""

    id: int | str
    file_name: str
    width: int
    height: int


class CocoAnnotation(BaseModel):
    """An annotation as it stands in the file; `decode_segmentation` checks the mask, whoever needs it the category."""

    id: int
    image_id: int | str
    category_id: Any = None
    segmentation: Any = None
    iscrowd: int = 0


class CocoFile(BaseModel):
    """What every COCO file holds."""

    images: list[CocoImage]
    annotations: list[CocoAnnotation]


class Rle(BaseModel):
    """A run-length encoded mask as it stands in the file; size is (height, width)."""

    size: tuple[int, int]
    counts: str | list[NonNegativeInt]


Crowd = Literal["mask", "ignore"]
_SEGMENTATION: TypeAdapter[list[list[float]] | Rle] = TypeAdapter(list[list[FiniteFloat]] | Rle)


def read_coco(path: Path, scene: Scene, *, crowd: Crowd = "mask") -> list[list[tuple[int, np.ndarray]]]:
    """The masks of a COCO file, view by view, as they stand there (in the frame of the photo).

    Images are found by file name: the path of the view's photo, or the view's name with or without suffix; a shorter
    path will do if it fits one view only. Images that are not in the scene are left out. Warns (InputWarning) of
    crowds, and of annotations of images that the file does not list.

    Args:
        path: the file.
        scene: gives the views and their sizes.
        crowd: what an annotation with `iscrowd` is: "mask", one like all others (supervision writes so for every mask
            with holes or several parts, datumaro for all masks), or "ignore", left out as COCO's own evaluation does.

    Returns:
        V lists of (annotation id, (height, width) bool mask); a view without annotations has an empty list.

    Raises:
        InputError: the file is broken, a view has no image entry, an entry fits several views or has another size than
            its camera, or a segmentation cannot be decoded.
    """
    coco = read_json(path, CocoFile)
    image_ids = {image.id for image in coco.images}
    orphans = [annotation.id for annotation in coco.annotations if annotation.image_id not in image_ids]
    if orphans:
        message = f"{len(orphans)} annotations are of no image in the file, the first is annotation {orphans[0]}"
        warnings.warn(f"{path}: {message}", InputWarning, stacklevel=4)
    view_of = [_find_view(path, image.file_name, scene) for image in coco.images]
    masks: list[list[tuple[int, np.ndarray]]] = []
    num_crowds = 0
    for index, view in enumerate(scene.views):
        entries = [image for image, image_view in zip(coco.images, view_of, strict=True) if image_view == index]
        if not entries:
            raise InputError(f"{path}: view {index} ({view.name}) has no entry among the images")
        width, height = scene.cameras.sizes[index].tolist()
        for image in entries:
            if (image.width, image.height) != (width, height):
                raise InputError(
                    f"{path}: image {image.file_name} is {image.width} x {image.height}, "
                    f"its camera says {width} x {height}"
                )
        entry_ids = {image.id for image in entries}
        shown = [annotation for annotation in coco.annotations if annotation.image_id in entry_ids]
        kept = [annotation for annotation in shown if crowd == "mask" or not annotation.iscrowd]
        masks.append([(annotation.id, _decode(path, annotation, (width, height))) for annotation in kept])
        num_crowds += sum(bool(annotation.iscrowd) for annotation in shown)
    if num_crowds:
        what = "taken as masks (--coco_crowd ignore leaves them out)" if crowd == "mask" else "left out"
        warnings.warn(f"{path}: {num_crowds} annotations with iscrowd are {what}", InputWarning, stacklevel=4)
    return masks


def _find_view(path: Path, file_name: str, scene: Scene) -> int | None:
    name = file_name.replace("\\", "/").removeprefix("./")
    same_name = [i for i, view in enumerate(scene.views) if view.name in (name, name.rsplit(".", 1)[0])]
    fitting = same_name or [
        i for i, view in enumerate(scene.views) if f"/{view.path.as_posix()}".endswith("/" + name)
    ]
    if len(fitting) > 1:
        views = " or ".join(f"{i} ({scene.views[i].name})" for i in fitting)
        raise InputError(f"{path}: image {file_name} could be view {views}, expected its path")
    return fitting[0] if fitting else None


def _decode(path: Path, annotation: CocoAnnotation, size: tuple[int, int]) -> np.ndarray:
    try:
        return decode_segmentation(annotation.segmentation, *size)
    except InputError as error:
        raise InputError(f"{path}: annotation {annotation.id}: {error}") from None


def decode_segmentation(segmentation: Any, width: int, height: int) -> np.ndarray:
    """(height, width) bool mask of an annotation's "segmentation": polygons, run lengths, or compressed run lengths.

    Args:
        segmentation: as json read it, unchecked.
        width: of the image, pixels.
        height: of the image, pixels.

    Raises:
        InputError: another form, a number that is not finite, another size, run lengths that do not add up to the
            image, or polygons far larger than it. The message is a reason, without the annotation's id.
    """
    try:
        checked = _SEGMENTATION.validate_python(segmentation)
    except ValidationError:
        raise InputError("its segmentation is neither polygons of finite numbers nor run lengths with a size") from None
    if isinstance(checked, list):
        return _decode_polygons(checked, width, height)
    if checked.size != (height, width):
        raise InputError(f"its mask is {checked.size[1]} x {checked.size[0]}, expected {width} x {height}")
    return decode_rle(checked.counts, width, height)


def _decode_polygons(polygons: list[list[float]], width: int, height: int) -> np.ndarray:
    """pycocotools walks along every edge in steps of a fifth of a pixel and keeps them all: far corners, or many long
    edges, would ask for memory without end."""
    if not polygons or any(len(polygon) < 6 or len(polygon) % 2 for polygon in polygons):
        raise InputError("its segmentation is not of the expected polygons x1, y1, x2, y2, x3, y3 and so on")
    outlines = [np.array(polygon).reshape(-1, 2) for polygon in polygons]
    if max(np.abs(corners).max() for corners in outlines) > 10 * max(width, height):
        raise InputError("a polygon leads far out of the image")
    length = sum(np.abs(corners - np.roll(corners, 1, axis=0)).max(1).sum() for corners in outlines)
    if length > width * height + 100 * (width + height):  # the outline of every second pixel is as long as this
        raise InputError(f"its polygons are {length:.0f} pixels long, more than any outline in the image")
    rle = coco_mask.merge(coco_mask.frPyObjects(polygons, height, width))
    return decode_rle(rle["counts"].decode("ascii"), width, height)


def decode_rle(counts: str | list[int], width: int, height: int) -> np.ndarray:
    """(height, width) bool from the counts of a COCO RLE, compressed or not: run lengths down the columns, 0 first.

    pycocotools leaves uninitialised memory where the counts are too short; here that is an error.

    Raises:
        InputError: the counts do not add up to the image.
    """
    runs = _decompress(counts) if isinstance(counts, str) else counts
    if min(runs, default=0) < 0 or sum(runs) != width * height:
        raise InputError(f"its run lengths do not add up to {width} x {height} pixels")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def _decompress(counts: str) -> list[int]:
    """Run lengths from COCO's string: 5 bits per character, lowest first, the sixth bit says that more follow; from the
    fourth run on, the difference from the run before the last."""
    runs: list[int] = []
    number = shift = 0
    for character in counts:
        bits = ord(character) - 48
        number |= (bits & 0x1F) << shift
        shift += 5
        if shift > 60:  # nobody has so many pixels
            raise InputError("its run lengths are not a string that COCO writes")
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
