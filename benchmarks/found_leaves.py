"""Which leaves does a set of masks find? A mask finds a leaf with an IoU of 0.5; one leaf is found by one mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mvseg.evaluation.truth import tied_instances
from mvseg.regions import Regions

FOUND_IOU = 0.5


def credit_masks(regions: Regions, scores: Tensor, truth: Sequence[np.ndarray]) -> Tensor:
    """The leaf that each mask is credited with.

    Args:
        regions: N masks in V views.
        scores: (N,); of several masks of one leaf in one view the one with the highest score gets it.
        truth: V label maps of the true leaves.

    Returns:
        (N,) int64, 0 for masks that find no leaf, or one that is taken.
    """
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
