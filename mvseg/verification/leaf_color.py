"""What has the colour of leaves that were found: other pixels of that colour may be leaves that were missed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mvseg.formats.photos import ReadPhoto
from mvseg.masks import SURE, Masks
from mvseg.verification.numbers import COLORS

CHANNELS, RANGES = (0, 1, 2), (0, 256) * 3  # definition: as OpenCV asks for them


@dataclass(frozen=True, eq=False)
class ColorCounts:
    """How often each colour occurs.

    Attributes:
        inside: (bins, bins, bins) int64, pixels of masks by red, green and blue.
        outside: the same for all other pixels.
    """

    inside: np.ndarray
    outside: np.ndarray

    @staticmethod
    def none() -> ColorCounts:
        return ColorCounts(np.zeros((COLORS.bins,) * 3, np.int64), np.zeros((COLORS.bins,) * 3, np.int64))

    def __add__(self, other: ColorCounts) -> ColorCounts:
        return ColorCounts(self.inside + other.inside, self.outside + other.outside)


def count_colors(photo: np.ndarray, is_inside: np.ndarray) -> ColorCounts:
    """The colours of a photo (H, W, 3) uint8 RGB, inside and outside of a mask (H, W) bool."""
    inside, outside = (_count(photo, part) for part in (is_inside, ~is_inside))
    return ColorCounts(inside, outside)


def leaf_colors(counts: ColorCounts) -> np.ndarray:
    """(bins, bins, bins) bool: colours that are more frequent inside than outside, each as a share of its side.

    Leaves that were missed are counted outside. As long as they are a small part of it, their colours are
    rarer there than inside. No colour is a leaf's when nothing is inside.
    """
    inside, outside = (
        gaussian_filter(counted / max(counted.sum(), 1), COLORS.blur, mode="constant")
        for counted in (counts.inside.astype(np.float64), counts.outside.astype(np.float64))
    )
    return inside > outside


def has_leaf_color(photo: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(H, W) bool, the pixels of a photo (H, W, 3) uint8 RGB whose colour is one of `leaf_colors`."""
    share = cv2.Mat(colors.astype(np.float32), wrap_channels=False)
    has: np.ndarray = cv2.calcBackProject([photo], CHANNELS, share, RANGES, scale=1) > 0
    return has


def _count(photo: np.ndarray, part: np.ndarray) -> np.ndarray:
    pixels, mask = photo.reshape(-1, 1, 3), part.reshape(-1, 1).astype(np.uint8)
    counted = cv2.calcHist([pixels], CHANNELS, mask, (COLORS.bins,) * 3, RANGES)
    return counted.astype(np.int64)


def thin_views(
    masks: Masks, photos: ReadPhoto, *, most_px: int
) -> tuple[list[tuple[np.ndarray, np.ndarray, int]], np.ndarray]:
    """Every `step`-th pixel of V views, so that longer sides have `most_px` or fewer; and the colours of leaves there.

    Returns:
        V of (h, w, 3) the photo, (h, w) the row of the mask there, -1 for none, and `step`; and the `leaf_colors` by
        all masks that are matched.
    """
    is_leaf = np.append(masks.instance_ids.numpy() > 0, False)  # the last one is for row -1
    views, counts = [], ColorCounts.none()
    for view in range(masks.regions.num_views):
        photo = photos(view)
        height, width = photo.shape[:2]
        step = -(-max(height, width) // most_px)
        thin = np.ascontiguousarray(photo[::step, ::step])
        rows = np.full(thin.shape[:2], -1)
        for row in (masks.view_index == view).nonzero()[:, 0].tolist():
            crop = masks.regions.placed(row)
            left, top = (-(-start // step) for start in crop.box[:2])
            pixels = crop.pixels.numpy()[top * step - crop.box[1] :: step, left * step - crop.box[0] :: step]
            rows[top : top + pixels.shape[0], left : left + pixels.shape[1]][pixels] = row
        views.append((thin, rows, step))
        counts += count_colors(views[-1][0], is_leaf[views[-1][1]])
    return views, leaf_colors(counts)


def colored_shares(masks: Masks, photos: ReadPhoto, colors: NDArray[np.bool_]) -> torch.Tensor:
    """(D,) float64: share of each mask that has one of the `leaf_colors`."""
    shares = torch.zeros(len(masks), dtype=torch.float64)
    for view in masks.view_index.unique().tolist():
        is_colored = torch.from_numpy(has_leaf_color(photos(view), colors))
        for row in (masks.view_index == view).nonzero()[:, 0].tolist():
            mask = masks.regions.placed(row)
            shares[row] = (mask.pixels & mask.cut(is_colored)).sum() / mask.area
    return shares


def colors_of_leaves(masks: Masks, photos: ReadPhoto) -> NDArray[np.bool_]:
    """The colours of masks that are surely matched; where there are none, those of all that are matched."""
    is_matched = masks.instance_ids > 0
    is_sure = is_matched & (masks.match_scores >= SURE)
    chosen = is_sure if is_sure.any() else is_matched
    counts = ColorCounts.none()
    for view in range(masks.regions.num_views):
        photo = photos(view)
        size = photo.shape[1], photo.shape[0]
        counts += count_colors(photo, masks.regions.label_map(view, chosen.long(), size).numpy() > 0)
    return leaf_colors(counts)
