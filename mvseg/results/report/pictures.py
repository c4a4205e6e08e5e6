"""Pictures of a photo on the page: its part with the plant, a thumbnail of the whole, and the outlines of the masks."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.crop import Box
from mvseg.formats.image_file import encode_jpeg
from mvseg.masks import SURE, Masks
from mvseg.results.overlay import find_plant, find_thickest

LARGEST_WIDTH, LEAST_WIDTH = 1600, 200  # limit: pixels of a picture, at most and at least
ALL_PIXELS = 24_000_000  # limit: max. pixels of all pictures together: 4 to 9 MB, large enough to correct masks in
THUMBNAIL_WIDTH = 320  # limit: pixels of a thumbnail, which is also shown around the picture of the plant
QUALITY = 80  # chosen: quality of JPEG pictures
UNITS = 2000  # limit: units across the picture of a view: the numbers of its outlines are whole ones
TOLERANCE = 1.5  # limit: max. distance of an outline from the edge of its mask, in units
LEAST_HEIGHT, LARGEST_HEIGHT = 36, 110  # limit: units of the height of a number in the picture, at least and at most


@dataclass(frozen=True, eq=False)
class Picture:
    """One view.

    Attributes:
        jpeg: the part of the photo with the plant, or all of it.
        thumbnail: JPEG of the whole photo.
        box: xyxy of that part, in shares of the photo's width and height.
        proportion: its height / width.
        outlines: of its masks, see `outline_masks`.
    """

    jpeg: bytes
    thumbnail: bytes
    box: tuple[float, float, float, float]
    proportion: float
    outlines: list[dict[str, Any]]

    def as_json(self) -> dict[str, Any]:
        """Data that the page reads; JPEGs in base64."""
        return {
            "jpeg": base64.b64encode(self.jpeg).decode("ascii"),
            "thumbnail": base64.b64encode(self.thumbnail).decode("ascii"),
            "box": [round(share, 5) for share in self.box],
            "proportion": round(self.proportion, 5),
            "masks": self.outlines,
        }

    def with_masks(self, masks: Masks, *, view: int, size: tuple[int, int]) -> Picture:
        """The same picture with the outlines of other masks; `size`: width and height of the photo, pixels."""
        x1, y1, x2, y2 = (round(share * side) for share, side in zip(self.box, size * 2, strict=True))
        return replace(self, outlines=outline_masks(masks, view=view, box=(x1, y1, x2, y2)))

    def place(self, xy: NDArray[Any], size: Sequence[int]) -> list[list[int]]:
        """Pixel positions (N, 2) of the photo, of that width and height, in whole units of the picture."""
        x1, y1, x2, _ = np.array(self.box) * (*size, *size)
        return np.round(_place(xy, (x1, y1, x2, 0))).astype(int).tolist()


def draw_picture(photo: np.ndarray, masks: Masks, *, view: int, is_whole: bool = False) -> Picture:
    """The picture of one view, from its photo (H, W, 3) uint8 RGB, undistorted; the more views, the smaller, so that a
    page of 60 views can still be sent. `is_whole`: of all of it, since leaves are looked for that no mask shows."""
    height, width = photo.shape[:2]
    box = x1, y1, x2, y2 = (0, 0, width, height) if is_whole else find_plant(masks, view=view, size=(width, height))
    proportion = (y2 - y1) / (x2 - x1)
    wide = min(x2 - x1, picture_width(masks.regions.num_views, proportion))
    jpeg, thumbnail = _shrink(photo[y1:y2, x1:x2], wide), _shrink(photo, min(width, THUMBNAIL_WIDTH))
    shares = (x1 / width, y1 / height, x2 / width, y2 / height)
    return Picture(jpeg, thumbnail, shares, proportion, outlines=outline_masks(masks, view=view, box=box))


def picture_width(num_views: int, proportion: float) -> int:
    """Width in pixels at which the pictures of all views (height / width = proportion) have at most `ALL_PIXELS`."""
    width = math.sqrt(ALL_PIXELS / num_views / proportion)
    return int(min(max(width, LEAST_WIDTH), LARGEST_WIDTH))


def _shrink(image: np.ndarray, width: int) -> bytes:
    height = max(1, round(width * image.shape[0] / image.shape[1]))
    return encode_jpeg(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), quality=QUALITY)


def outline_masks(masks: Masks, *, view: int, box: Box) -> list[dict[str, Any]]:
    """The masks of one view as the page reads them, in units of the picture, of which it is 2000 wide; large ones
    first, so that small ones lie on top; those outside of the shown part of the photo (`box`, xyxy, pixels), too: the
    user may look for them.

    The number of a mask goes `at` the middle of its thickest place; holes of its SVG `path` are paths of their own
    (even-odd rule); it `is_sure` if its `match_score` (see `Matching`) is at least 0.5.
    """
    regions = masks.regions
    outlines = []
    for region in (each for each in regions.large_first(view) if regions.areas[each]):
        mask = regions.crop(region).cpu().numpy().astype(np.uint8)
        corner = np.array(regions.boxes[region, :2].tolist())
        path, around = trace_mask(mask, corner, box=box)
        middle, radius = find_thickest(mask)
        x, y = np.round(_place(np.array(middle) + corner + 0.5, box)).astype(int).tolist()
        thickness = 2 * radius * UNITS / (box[2] - box[0])
        score, detected = float(masks.match_scores[region]), float(masks.detection_scores[region])
        outline = {
            "region": region,
            "leaf": int(masks.instance_ids[region]),
            "path": path,
            "box": around,
            "at": (x, y),
            "height": int(np.clip(thickness, LEAST_HEIGHT, LARGEST_HEIGHT)),
            "match_score": round(score, 4),
            "is_sure": score >= SURE,
        }
        outlines.append(outline if math.isnan(detected) else outline | {"detection_score": round(detected, 4)})
    return outlines


def trace_mask(mask: NDArray[np.uint8], corner: NDArray[np.int64], *, box: Box) -> tuple[str, Box]:
    """The outline of a mask (h, w) of at least one pixel as a path of SVG, and the box around it. `corner` (2,) is the
    column and row of its top-left pixel in the photo, `box` the part that is `UNITS` wide."""
    lines, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parts, corners = [], []
    for line in lines:
        placed = _place(line[:, 0] + corner + 0.5, box).astype(np.float32)
        points = np.round(cv2.approxPolyDP(placed, TOLERANCE, True)[:, 0]).astype(int)
        steps = np.diff(points, axis=0).ravel().tolist()
        parts.append(f"M{points[0, 0]} {points[0, 1]}l{' '.join(map(str, steps or [0, 0]))}z")
        corners.append(points)
    x1, y1 = np.concatenate(corners).min(0).tolist()
    x2, y2 = np.concatenate(corners).max(0).tolist()
    return "".join(parts), (x1, y1, x2, y2)


def _place(xy: NDArray[Any], box: Box) -> NDArray[np.float64]:
    return np.asarray((xy - np.array(box[:2])) * UNITS / (box[2] - box[0]), dtype=np.float64)
