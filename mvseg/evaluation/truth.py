"""True instances that masks show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from mvseg.regions import Regions


def true_instance(truth: np.ndarray, mask: np.ndarray, *, count_background: bool = True) -> int:
    """The true instance that one mask shows: the most frequent true label under it, the smallest of equals.

    `truth` (H, W) has integers: 0 = no instance, 65535 = ignore; `mask` (H, W) is not 0 inside. `count_background` is
    False for masks that are known to show an instance but may extend beyond it. Returns 0 for a mask without pixels,
    for one that mostly covers no instance, or, without `count_background`, covers none at all; 65535 for a mask that is
    mostly ignored.
    """
    counts = np.bincount(truth[mask != 0].ravel(), minlength=1)
    if not count_background:
        counts[0] = 0
    return int(counts.argmax())


def true_instances(regions: Regions, truth: Sequence[np.ndarray], *, count_background: bool = True) -> Tensor:
    """(D,) int64 on the CPU: `true_instance` of every region; `truth` are V label maps in the frame of the regions."""
    shown = [true_instance(*crop, count_background=count_background) for crop in region_crops(regions, truth)]
    return torch.tensor(shown, dtype=torch.int64)


def region_crops(regions: Regions, truth: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The truth in each region's box, and the region's mask there."""
    for index, view in enumerate(regions.view_index.tolist()):
        crop = regions.placed(index)
        yield crop.cut(truth[view]), crop.pixels.cpu().numpy()
