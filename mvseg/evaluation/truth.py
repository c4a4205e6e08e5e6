"""Which true instance a mask shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from mvseg.regions import IGNORE_LABEL, Regions


def shown_instance(truth: np.ndarray, mask: np.ndarray, *, count_background: bool = True) -> int:
    """The true instance that one mask shows: the most frequent true label under it.

    Args:
        truth: (H, W) integers: 0 = no instance, 65535 = ignore.
        mask: (H, W), not 0 inside the mask.
        count_background: False for masks that are known to show an instance but may extend beyond it.

    Returns:
        The label, the smallest of equally frequent ones. 0 for a mask without pixels, for one that mostly covers no
        instance, or, without `count_background`, covers none at all. 65535 for a mask that is mostly ignored.
    """
    counts = np.bincount(truth[mask != 0].ravel(), minlength=1)
    if not count_background:
        counts[0] = 0
    return int(counts.argmax())


def shown_instances(
    regions: Regions, truth: Sequence[np.ndarray], *, count_background: bool = True
) -> Tensor:
    """(D,) int64 on the CPU: `shown_instance` of every region; `truth` are V label maps in the frame of the regions."""
    shown = (shown_instance(labels, mask, count_background=count_background) for labels, mask in _crops(regions, truth))
    return torch.tensor(list(shown), dtype=torch.int64)


def tied_instances(regions: Regions, truth: Sequence[np.ndarray], *, min_iou: float = 0.5) -> Tensor:
    """The true instance that each region covers well enough to count as found.

    Args:
        regions: D regions, as a detector finds them.
        truth: V label maps (H, W): 0 = no instance, 65535 = ignore.
        min_iou: least IoU with the visible part of the instance.

    Returns:
        (D,) int64 on the CPU: the instance with the largest IoU; 0 where that is below `min_iou`. Two regions may be
        tied to one instance.
    """
    sizes = [np.bincount(labels.ravel(), minlength=1) for labels in truth]
    ids = []
    for view, (labels, mask) in zip(regions.view_index.tolist(), _crops(regions, truth), strict=True):
        intersection = np.bincount(labels[mask], minlength=len(sizes[view]))
        iou = intersection / np.maximum(sizes[view] + mask.sum() - intersection, 1)
        iou[[0, *range(IGNORE_LABEL, len(iou))]] = 0
        best = int(iou.argmax())
        ids.append(best if iou[best] >= min_iou else 0)
    return torch.tensor(ids, dtype=torch.int64)


def _crops(regions: Regions, truth: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The truth in each region's box, and the region's mask there."""
    for index, (view, (x1, y1, x2, y2)) in enumerate(
        zip(regions.view_index.tolist(), regions.boxes.tolist(), strict=True)
    ):
        yield truth[view][y1:y2, x1:x2], regions.crop(index).cpu().numpy()
