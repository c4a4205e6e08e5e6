"""Which leaves does a set of masks find? A mask finds a leaf with an IoU of 0.5; one leaf is found by one mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mvseg.evaluation.truth import region_crops
from mvseg.regions import IGNORE_LABEL, Regions

FOUND_IOU = 0.5


def credit_masks(regions: Regions, scores: Tensor, truth: Sequence[np.ndarray]) -> Tensor:
    """(N,) int64, the leaf that each of N masks is credited with, 0 for masks that find no leaf, or one that is taken:
    of several masks of one leaf in one view the one with the highest score gets it."""
    leaf = tied_instances(regions, truth, min_iou=FOUND_IOU)
    taken: set[tuple[int, int]] = set()
    for index in scores.argsort(descending=True, stable=True).tolist():
        key = int(regions.view_index[index]), int(leaf[index])
        if key in taken:
            leaf[index] = 0
        taken.add(key)
    return leaf


def is_found(truth: Regions, regions: Regions, credited: Tensor) -> Tensor:
    """(D,) bool: which of D true regions (their `labels` are the leaves) are found by a mask in their view."""
    found = set(zip(regions.view_index.tolist(), credited.tolist(), strict=True))
    keys = zip(truth.view_index.tolist(), truth.labels.tolist(), strict=True)
    return torch.tensor([key in found for key in keys], dtype=torch.bool)


def tied_instances(regions: Regions, truth: Sequence[np.ndarray], *, min_iou: float = 0.5) -> Tensor:
    """(D,) int64 on the CPU: the true instance (65535 = ignore) with whose visible part each region has the largest
    IoU; 0 where that is below `min_iou`. Two regions may be tied to one instance."""
    sizes = [np.bincount(labels.ravel(), minlength=1) for labels in truth]
    ids = []
    for view, (labels, mask) in zip(regions.view_index.tolist(), region_crops(regions, truth), strict=True):
        intersection = np.bincount(labels[mask], minlength=len(sizes[view]))
        iou = intersection / np.maximum(sizes[view] + mask.sum() - intersection, 1)
        iou[[0, *range(IGNORE_LABEL, len(iou))]] = 0
        best = int(iou.argmax())
        ids.append(best if iou[best] >= min_iou else 0)
    return torch.tensor(ids, dtype=torch.int64)
