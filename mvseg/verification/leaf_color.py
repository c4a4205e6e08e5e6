"""What has the colour of the confirmed masks: unconfirmed pixels of that colour may be leaves that were missed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

BINS = 16  # per channel
BLUR = 1.0  # bins


@dataclass(frozen=True, eq=False)
class ColorCounts:
    """How often each colour occurs.

    Attributes:
        inside: (BINS, BINS, BINS) int64, pixels of confirmed masks by red, green and blue.
        outside: the same for all other pixels.
    """

    inside: np.ndarray
    outside: np.ndarray

    @staticmethod
    def none() -> ColorCounts:
        return ColorCounts(np.zeros((BINS,) * 3, np.int64), np.zeros((BINS,) * 3, np.int64))

    def __add__(self, other: ColorCounts) -> ColorCounts:
        return ColorCounts(self.inside + other.inside, self.outside + other.outside)


def count_colors(photo: np.ndarray, is_inside: np.ndarray) -> ColorCounts:
    """The colours of a photo (H, W, 3) uint8 RGB, inside and outside of a mask (H, W) bool."""
    bins = _color_bins(photo)
    inside, outside = (np.bincount(bins[part], minlength=BINS**3) for part in (is_inside, ~is_inside))
    return ColorCounts(inside.reshape((BINS,) * 3), outside.reshape((BINS,) * 3))


def leaf_colors(counts: ColorCounts) -> np.ndarray:
    """(BINS, BINS, BINS) bool: colours that are more frequent inside than outside, each as a share of its side.

    Leaves that were missed are counted outside. As long as they are a small part of what is outside, their colours are
    rarer there than inside. No colour is a leaf's when nothing is inside.
    """
    inside, outside = (
        gaussian_filter(counted / max(counted.sum(), 1), BLUR, mode="constant")
        for counted in (counts.inside.astype(np.float64), counts.outside.astype(np.float64))
    )
    return inside > outside


def has_leaf_color(photo: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(H, W) bool, the pixels of a photo (H, W, 3) uint8 RGB whose colour is one of `leaf_colors`."""
    return colors.ravel()[_color_bins(photo)]


def _color_bins(photo: np.ndarray) -> np.ndarray:
    red, green, blue = ((photo[..., channel] // (256 // BINS)).astype(np.uint16) for channel in range(3))
    bins: np.ndarray = (red * BINS + green) * BINS + blue
    return bins
