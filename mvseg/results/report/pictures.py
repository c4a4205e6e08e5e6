"""What the page shows of a photo: its part with the plant, a thumbnail of the whole, and the outlines of the masks."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from mvseg.formats.image_file import encode_jpeg
from mvseg.masks import Masks
from mvseg.results.overlay import find_plant
from mvseg.results.report.outlines import Outline, outline_masks

LARGEST_WIDTH, LEAST_WIDTH = 1600, 200  # pixels of a picture
ALL_PIXELS = 24_000_000  # of all pictures together: 4 to 9 MB, large enough to correct masks in
THUMBNAIL_WIDTH = 320  # also shown around the picture of the plant
QUALITY = 80  # of JPEGs


@dataclass(frozen=True, eq=False)
class Picture:
    """One view.

    Attributes:
        jpeg: the part of the photo with the plant.
        thumbnail: JPEG of the whole photo.
        box: xyxy of that part, in shares of the photo's width and height.
        proportion: its height / width.
        outlines: of the masks.
    """

    jpeg: bytes
    thumbnail: bytes
    box: tuple[float, float, float, float]
    proportion: float
    outlines: list[Outline]

    def as_json(self) -> dict[str, Any]:
        """What the page reads, except for the masks; JPEGs in base64."""
        return {
            "jpeg": base64.b64encode(self.jpeg).decode("ascii"),
            "thumbnail": base64.b64encode(self.thumbnail).decode("ascii"),
            "box": [round(share, 5) for share in self.box],
            "proportion": round(self.proportion, 5),
        }

    def with_masks(self, masks: Masks, *, view: int, size: tuple[int, int]) -> Picture:
        """The same picture with the outlines of other masks; `size`: width and height of the photo, pixels."""
        x1, y1, x2, y2 = (round(share * side) for share, side in zip(self.box, size * 2, strict=True))
        return replace(self, outlines=outline_masks(masks, view=view, box=(x1, y1, x2, y2)))


def draw_picture(photo: np.ndarray, masks: Masks, *, view: int) -> Picture:
    """The picture of one view; the more views there are, the smaller, so that a page of 60 views can still be sent.

    Args:
        photo: (H, W, 3) uint8 RGB, undistorted.
        masks: D masks.
        view: index of the view.
    """
    height, width = photo.shape[:2]
    box = x1, y1, x2, y2 = find_plant(masks, view=view, size=(width, height))
    proportion = (y2 - y1) / (x2 - x1)
    wide = min(x2 - x1, picture_width(masks.regions.num_views, proportion))
    return Picture(
        jpeg=_shrink(photo[y1:y2, x1:x2], wide),
        thumbnail=_shrink(photo, min(width, THUMBNAIL_WIDTH)),
        box=(x1 / width, y1 / height, x2 / width, y2 / height),
        proportion=proportion,
        outlines=outline_masks(masks, view=view, box=box),
    )


def picture_width(num_views: int, proportion: float) -> int:
    """Width in pixels at which the pictures of all views (height / width = proportion) have at most `ALL_PIXELS`."""
    width = math.sqrt(ALL_PIXELS / num_views / proportion)
    return int(min(max(width, LEAST_WIDTH), LARGEST_WIDTH))


def _shrink(image: np.ndarray, width: int) -> bytes:
    height = max(1, round(width * image.shape[0] / image.shape[1]))
    return encode_jpeg(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), quality=QUALITY)
