"""Masks of the target's shapes in a photo, by their plain colour."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import threshold_otsu

from mvseg.arrays import Floats
from mvseg.checks.numbers import IMAGES

LUMA = np.array([0.299, 0.587, 0.114])  # brightness as JPEG has it


def cut_shapes(photo: NDArray[np.uint8], places: Mapping[int, tuple[Floats, Floats]]) -> NDArray[np.uint16]:
    """Label map (H, W) of the shapes that were found in one photo (H, W, 3) RGB, 0 where none is. A mask is what
    differs in colour from the paper of its cell. The outline only decides whether it is the shape: its edge plays no
    part in the mask.

    Args:
        places: {label: cell and outline}, where they should be: (4, 2) pixels around the shape and white paper, which
            may lie partly outside; and (P, 2) pixels of the shape, all in the photo.
    """
    height, width = photo.shape[:2]
    labels = np.zeros((height, width), np.uint16)
    for label, (cell, outline) in places.items():
        low, high = np.floor(cell.min(0)), np.ceil(cell.max(0))
        (x1, y1), (x2, y2) = (np.clip(each, 0, (width, height)).astype(int) for each in (low, high))
        part = photo[y1:y2, x1:x2]
        mask = _cut(part, _fill(cell - (x1, y1), part.shape[:2]))
        shape = _fill(outline - (x1, y1), part.shape[:2])
        if (mask & shape).sum() >= IMAGES.least_iou * (mask | shape).sum():
            labels[y1:y2, x1:x2][mask] = label
    return labels


def _cut(part: NDArray[np.uint8], is_cell: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) bool: the largest piece of a cell that is ink by half or more, by brightness; reflections are filled."""
    light = ((part + 1.0) / 256) ** IMAGES.gamma
    lack = 1 - 2 * light[..., 1] / (light[..., 0] + light[..., 2])  # of green, in any light and shade: magenta
    is_ink = lack > threshold_otsu(lack[is_cell])
    if not (is_ink & is_cell).any():  # grey all over
        return is_ink & is_cell
    colors = np.stack([np.median(light[is_cell & where], 0) for where in (~is_ink, is_ink)])
    strength = cv2.GaussianBlur((light @ np.linalg.pinv(colors)).sum(2), (0, 0), IMAGES.smooth_px).clip(0)
    half = colors.mean(0) ** (1 / IMAGES.gamma) @ LUMA
    pieces, count = ndimage.label((part / 255 @ LUMA < half * strength ** (1 / IMAGES.gamma)) & is_cell)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray(ndimage.binary_fill_holes(pieces == sizes.argmax()))


def _fill(polygon: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    filled = np.zeros(size, np.uint8)
    corners = np.round((polygon - 0.5) * (1 << IMAGES.shift)).astype(np.int32)
    return np.asarray(cv2.fillPoly(filled, [corners], 1, shift=IMAGES.shift), bool)
