"""What the page shows of a photo: its part with the plant, a small one of the whole, and the outlines of the masks."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mvseg.formats.image_file import encode_jpeg
from mvseg.masks import Masks
from mvseg.results.overlay import find_plant
from mvseg.results.report.outlines import Outline, outline_masks

LARGEST_WIDTH, LEAST_WIDTH = 960, 200  # pixels of a picture
ALL_PIXELS = 10_000_000  # of all pictures together: 2 to 3 MB
THUMBNAIL_WIDTH = 128
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
        """What the page reads; JPEGs in base64."""
        return {
            "jpeg": base64.b64encode(self.jpeg).decode("ascii"),
            "thumbnail": base64.b64encode(self.thumbnail).decode("ascii"),
            "box": [round(share, 5) for share in self.box],
            "proportion": round(self.proportion, 5),
            "masks": [outline.as_json() for outline in self.outlines],
        }


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
    """Width in pixels at which so many pictures (height / width = proportion) have no more than `ALL_PIXELS`."""
    width = math.sqrt(ALL_PIXELS / num_views / proportion)
    return int(min(max(width, LEAST_WIDTH), LARGEST_WIDTH))


def _shrink(image: np.ndarray, width: int) -> bytes:
    height = max(1, round(width * image.shape[0] / image.shape[1]))
    return encode_jpeg(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), quality=QUALITY)
