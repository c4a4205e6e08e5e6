"""labelme: one JSON file per photo, with polygons, rectangles, circles, or masks as small PNGs.

Shapes of one label and one `group_id` are parts of one leaf. labelme's own scripts leave out shapes that are called
`__ignore__` or `_background_`, and so does this reader. Points are continuous, the corner of the top-left pixel is
(0, 0), as in COCO, whose polygon codec is used.
"""

from __future__ import annotations

import base64
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL.PngImagePlugin import PngImageFile
from pydantic import BaseModel, FiniteFloat

from mvseg.errors import InputError, faults_of
from mvseg.formats.coco import check_segmentations, decode_segmentation
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.masks.found_mask import FoundMask

CIRCLE_CORNERS = 64  # limit: corners of the polygon of a circle
NO_MASKS = ("__ignore__", "_background_")


class _Shape(BaseModel):
    label: str
    points: Items[tuple[FiniteFloat, FiniteFloat]]
    group_id: int | str | None = None
    shape_type: str | None = "polygon"
    mask: str | None = None


class LabelmeFile(BaseModel):
    """Content of a labelme file."""

    shapes: Items[_Shape]
    imageWidth: int | None = None
    imageHeight: int | None = None


def read_labelme(path: Path, width: int, height: int) -> list[FoundMask]:
    """The masks of a photo, numbered from 1 in the order of their first shapes; lines, points and shapes that are to be
    ignored have no mask. Raises InputError if the file is broken, is of a photo of another size, all corners of its
    polygons lie between 0 and 1, or a shape is malformed."""
    content = read_json(path, LabelmeFile)
    size = (content.imageWidth or width, content.imageHeight or height)
    if size != (width, height):
        raise InputError(f"{path}: its photo is {size[0]} x {size[1]}, its camera says {width} x {height}")
    polygons = [shape.points for shape in content.shapes if shape.shape_type in (None, "polygon")]
    with faults_of(path):
        check_segmentations(([x for corner in points for x in corner], (width, height)) for points in polygons)
    parts: dict[tuple[str, Any], np.ndarray | None] = {}
    counts: Counter[tuple[str, Any]] = Counter()
    for index, shape in enumerate(content.shapes):
        with faults_of(f"{path}: shapes[{index}] ({shape.label})"):
            mask = _draw(shape, width, height)
        key = (shape.label, ("alone", index) if shape.group_id is None else shape.group_id)
        counts[key] += 1
        earlier = parts.get(key)
        parts[key] = mask if earlier is None else earlier if mask is None else earlier | mask
    numbered = enumerate(parts.items(), start=1)
    return [FoundMask(number, mask, key[0], num_parts=counts[key]) for number, (key, mask) in numbered]


@np.errstate(over="ignore", invalid="ignore")  # absurd corners become infinite, which the codec refuses
def _draw(shape: _Shape, width: int, height: int) -> np.ndarray | None:
    kind = shape.shape_type or "polygon"
    if kind in ("line", "linestrip", "point", "points") or shape.label in NO_MASKS:
        return None
    points = np.array(shape.points, np.float64).reshape(-1, 2)
    if kind in ("rectangle", "circle", "mask") and len(points) not in ((2, 4) if kind == "rectangle" else (2,)):
        raise InputError(f"a {kind} of {len(points)} points, expected 2")
    if kind == "mask":
        return _paste(shape.mask or "", points, width=width, height=height)
    if kind == "rectangle":
        (x1, y1), (x2, y2) = points.min(0), points.max(0)
        points = np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2]])
    elif kind == "circle":
        angles = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
        points = points[0] + np.hypot(*(points[1] - points[0])) * np.stack((np.cos(angles), np.sin(angles)), 1)
    elif kind not in ("polygon", "oriented_rectangle"):
        raise InputError(f"the shape type '{kind}' is not known, expected polygon, rectangle, circle or mask")
    return decode_segmentation([points.ravel().tolist()], width, height)


def _paste(text: str, points: np.ndarray, *, width: int, height: int) -> np.ndarray:
    try:
        with PngImageFile(BytesIO(base64.b64decode(text, validate=True))) as image:
            if image.width > width or image.height > height:
                raise InputError(f"its mask is {image.width} x {image.height}, larger than the photo")
            crop = np.asarray(image).astype(bool)
    except InputError:
        raise
    except Exception:  # Pillow raises almost anything on a damaged file
        raise InputError("its mask is not a whole PNG in base64") from None
    left, top = np.round(points.min(0)).astype(int).tolist()
    if crop.ndim != 2 or left < 0 or top < 0 or left + crop.shape[1] > width or top + crop.shape[0] > height:
        raise InputError("its mask does not lie in the photo")
    return np.pad(crop, ((top, height - top - crop.shape[0]), (left, width - left - crop.shape[1])))
