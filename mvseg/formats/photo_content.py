"""Content of a photo in a few numbers: is it blank, too dark or too bright, and does it have colours?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvseg.formats.image_file import is_grey

STEP = 4  # limit: every fourth row and column is used
WHITE = 250  # chosen: a pixel is white if all of its channels reach this value


@dataclass(frozen=True)
class PhotoContent:
    """The numbers of one photo.

    Attributes:
        contrast: standard deviation of its grey levels.
        level: grey level that 99 % of the pixels stay below.
        burnt: share of its pixels that are white.
    """

    contrast: float
    level: float
    burnt: float
    grey: bool


def measure_content(photo: np.ndarray) -> PhotoContent:
    """Measure a photo (H, W, 3) uint8 as it is stored: without its lens distortion it would have black corners."""
    pixels = photo[::STEP, ::STEP]
    levels = pixels.mean(2)
    return PhotoContent(
        contrast=float(levels.std()),
        level=float(np.quantile(levels, 0.99)),
        burnt=float((pixels.min(2) >= WHITE).mean()),
        grey=is_grey(pixels),
    )
