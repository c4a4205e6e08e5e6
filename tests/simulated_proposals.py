"""Region proposals like those of a detector, made from true masks: jittered boxes and masks, with duplicates."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from mvseg.crop import Crop
from mvseg.masks import Masks, Origin
from mvseg.regions import regions_from_label_maps, stack_regions


def simulate_proposals(
    label_maps: Sequence[np.ndarray], *, seed: int, copies: int = 5, jitter: float = 0.08
) -> tuple[Masks, Tensor]:
    """Several proposals of every visible instance.

    Each copy is the true mask, scaled and shifted so that the edges of its box move by a normal error of `jitter` of
    the box's side, and eroded or dilated by up to two pixels. Scores fall with the error, and for small regions.
    Returns the proposals and (R,) the label that each was made from.
    """
    rng = np.random.default_rng(seed)
    truth = regions_from_label_maps(label_maps)
    rows = list[tuple[int, Crop, int]]()
    scores, areas = [], truth.areas.tolist()
    for index, view in enumerate(truth.view_index.tolist()):
        height, width = label_maps[view].shape
        mask = truth.mask(index, width, height).numpy()
        prominence = min(1.0, (areas[index] / (0.01 * width * height)) ** 0.5)
        for _ in range(copies):
            error = rng.normal(0, jitter, 4)
            moved = _move_mask(mask, truth.boxes[index].numpy(), error=error, grow_px=int(rng.integers(-2, 3)))
            if not moved.any():
                continue
            rows.append((view, Crop.of(moved), int(truth.labels[index])))
            quality = float(np.exp(-np.square(error).sum() / (4 * jitter**2)))
            scores.append(0.2 + 0.4 * prominence + 0.3 * quality + 0.1 * rng.random())
    regions = stack_regions(rows, len(label_maps))
    return Masks.of(regions, detection_scores=torch.tensor(scores), origin=Origin.DETECTED), regions.labels


def _move_mask(mask: np.ndarray, box: np.ndarray, *, error: np.ndarray, grow_px: int) -> np.ndarray:
    """(H, W) bool: the mask stretched so that its box's edges move by `error` times the box's sides, then grown."""
    x1, y1, x2, y2 = box.astype(float)
    width, height = x2 - x1, y2 - y1
    left, top, right, bottom = error * np.array([width, height, width, height])
    scale_x = max(0.2, (width + right - left) / width)
    scale_y = max(0.2, (height + bottom - top) / height)
    there_from_here = np.array([[scale_x, 0, x1 + left - scale_x * x1], [0, scale_y, y1 + top - scale_y * y1]])
    moved = cv2.warpAffine(mask.astype(np.uint8), there_from_here, mask.shape[::-1], flags=cv2.INTER_NEAREST)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(grow_px) + 1,) * 2)
    moved = cv2.dilate(moved, kernel) if grow_px > 0 else cv2.erode(moved, kernel)
    return np.asarray(moved) > 0
