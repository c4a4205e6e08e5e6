"""Do two annotators agree, leaf by leaf?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from mvseg.evaluation.panoptic import find_all
from mvseg.regions import Regions


@dataclass(frozen=True)
class SharedLeaf:
    """A leaf that both have: its ids, and the IoU of all its pixels in all views, above 0.5."""

    leaf: int
    true: int
    iou: float


@dataclass(frozen=True)
class Agreement:
    """Agreement of two annotators of the same photos.

    Attributes:
        shared: leaves that both have, by the first's ids.
        alone: ids of leaves, ascending, that only the first has, but those that the second ignores; masks without an
            id are none.
        missed: ids of leaves that only the second has.
    """

    shared: tuple[SharedLeaf, ...]
    alone: tuple[int, ...]
    missed: tuple[int, ...]


def compare_annotators(regions: Regions, instance_ids: Tensor, truth: Sequence[np.ndarray]) -> Agreement:
    """Compare masks with ids, of one annotator, with the label maps of another; arguments and errors as in
    `leaf_metrics`. Exchanged, they have the same shared leaves, as long as masks of one view do not overlap."""
    judged = find_all(regions, instance_ids, truth)
    leaves = zip(judged.ids.tolist(), judged.leaves.true_segment.tolist(), judged.leaves.iou.tolist(), strict=True)
    found = {leaf: SharedLeaf(leaf, judged.labels[true], iou) for leaf, true, iou in leaves if true >= 0}
    shared = tuple(each for leaf, each in sorted(found.items()) if leaf > 0)
    return Agreement(
        shared=shared,
        alone=tuple(leaf for leaf in judged.ids[judged.leaves.is_false].tolist() if leaf > 0),
        missed=tuple(label for label in judged.labels if label not in {each.true for each in shared}),
    )
