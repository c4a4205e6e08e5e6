"""A rough box or line around a leaf becomes an outline: where the colours inside differ from those outside.

GrabCut (Rother, Kolmogorov, Blake 2004), as OpenCV has it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats, Pixels
from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.verification.numbers import SNAP
from mvseg.verification.snap_edges import cut_by_color


def refine_outline(photo: Pixels, rough: Floats) -> Floats:
    """Refine a rough outline in a photo (H, W, 3) uint8 RGB.

    Args:
        rough: (P, 2) x, y of corners around the leaf, P >= 3, pixels with centres at half integers. Nothing outside it
            can be leaf.

    Returns:
        (Q, 2) corners, Q >= 3, in the same pixels.

    Raises:
        InputError: the rough outline has no area in the photo, or nothing in it differs from what is around it.
    """
    height, width = photo.shape[:2]
    low, high = rough.min(0), rough.max(0)
    margin = max(EDITS.around * float((high - low).max()), EDITS.least_margin_px)
    x1, y1 = np.clip(np.floor(low - margin), 0, (width, height)).astype(int).tolist()
    x2, y2 = np.clip(np.ceil(high + margin), 0, (width, height)).astype(int).tolist()
    if min(x2 - x1, y2 - y1) < 2:
        raise InputError("the rough outline is not in the photo, expected one around a leaf")
    scale = min(1.0, EDITS.segmented_px / max(x2 - x1, y2 - y1))
    part = cv2.resize(photo[y1:y2, x1:x2], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    inside = np.zeros(part.shape[:2], np.uint8)
    cv2.fillPoly(inside, [np.round((rough - (x1, y1)) * scale - 0.5).astype(np.int32)], 1)
    if inside.sum() < SNAP.least_pixels or inside.all():
        raise InputError("the rough outline is too small or as large as the photo, expected one around a leaf")
    state = np.where(inside > 0, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    grown = cut_by_color(part, state, rounds=EDITS.rounds).astype(np.uint8)
    leaf = cv2.morphologyEx(grown, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    corners = trace_outline(leaf) if leaf.any() else np.zeros((1, 2))
    if cv2.contourArea(corners.astype(np.float32)) < EDITS.least_leaf * inside.sum():
        raise InputError("nothing inside differs from what is around it, expected an outline drawn by hand here")
    return np.asarray(corners / scale + (x1, y1), np.float64)


def trace_outline(mask: NDArray[Any]) -> Floats:
    """(P, 2) x, y of corners: the largest component of a mask (h, w) with a pixel or more, as a polygon."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    corners = cv2.approxPolyDP(max(lines, key=cv2.contourArea), EDITS.tolerance_px, True)[:, 0]
    return np.asarray(corners + 0.5, np.float64)
