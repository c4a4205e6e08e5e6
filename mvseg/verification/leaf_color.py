"""Colour model of accepted leaves, to find leaf-coloured pixels outside of masks."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from mvseg.arrays import Bools, Ints, Pixels
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.verification.numbers import COLORS

CHANNELS, RANGES = (0, 1, 2), (0, 256) * 3  # definition: as OpenCV asks for them


def count_colors(photo: Pixels, is_inside: Bools) -> Ints:
    """(2, bins, bins, bins) how often each colour occurs in a photo (H, W, 3) uint8 RGB, by red, green and blue: inside
    of a mask (H, W) bool, and outside."""
    pixels = photo.reshape(-1, 1, 3)
    parts = (part.reshape(-1, 1).astype(np.uint8) for part in (is_inside, ~is_inside))
    counts = [cv2.calcHist([pixels], CHANNELS, part, (COLORS.bins,) * 3, RANGES) for part in parts]
    return np.stack(counts).astype(np.int64)


def leaf_colors(counts: Ints) -> Bools:
    """(bins, bins, bins) bool: colours that are more frequent inside than outside, each as a share of its side.

    Leaves that were missed are counted outside. As long as they are a small part of it, their colours are
    rarer there than inside. No colour is a leaf's when nothing is inside.
    """
    inside, outside = (gaussian_filter(each / max(each.sum(), 1), COLORS.blur, mode="constant") for each in counts)
    return np.asarray(inside > outside)


def has_leaf_color(photo: Pixels, colors: Bools) -> Bools:
    """(H, W) bool, the pixels of a photo (H, W, 3) uint8 RGB whose colour is one of `leaf_colors`."""
    share = cv2.Mat(colors.astype(np.float32), wrap_channels=False)
    return np.asarray(cv2.calcBackProject([photo], CHANNELS, share, RANGES, scale=1) > 0)


def colored_shares(masks: Masks, photos: ReadPhoto, colors: Bools) -> torch.Tensor:
    """(D,) float64: share of each mask that has one of the `leaf_colors`."""
    shares = torch.zeros(len(masks), dtype=torch.float64)
    for view in masks.view_index.unique().tolist():
        is_colored = torch.from_numpy(has_leaf_color(photos(view), colors))
        for row in (masks.view_index == view).nonzero()[:, 0].tolist():
            mask = masks.regions.placed(row)
            shares[row] = (mask.pixels & mask.cut(is_colored)).sum() / mask.area
    return shares
