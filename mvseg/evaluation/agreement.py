"""Do two annotators agree? Leaf by leaf, and about the ids of the masks that both have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from mvseg.evaluation.id_metrics import contingency_table
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
        kappa: Cohen's kappa of the ids of masks that both have (IoU above 0.5 in their view; one each). An id of the
            one means that id of the other with which it shares most masks, one to one. 1 without such masks.
        shared: leaves that both have, by the first's ids.
        alone: ids of leaves, ascending, that only the first has, but those that the second ignores; masks without an
            id are none.
        missed: ids of leaves that only the second has.
    """

    kappa: float
    shared: tuple[SharedLeaf, ...]
    alone: tuple[int, ...]
    missed: tuple[int, ...]


def compare_annotators(regions: Regions, instance_ids: Tensor, truth: Sequence[np.ndarray]) -> Agreement:
    """Compare masks with ids, of one annotator, with the label maps of another; see `leaf_metrics` for the arguments
    and what it raises. Exchanged, they have the same kappa and the same shared leaves, as long as masks of one view do
    not overlap."""
    judged = find_all(regions, instance_ids, truth)
    is_shared = judged.masks.true_segment >= 0
    true_ids = np.array(judged.leaf_of_mask, np.int64)[judged.masks.true_segment[is_shared]]
    leaves = zip(judged.ids.tolist(), judged.leaves.true_segment.tolist(), judged.leaves.iou.tolist(), strict=True)
    found = {leaf: SharedLeaf(leaf, judged.labels[true], iou) for leaf, true, iou in leaves if true >= 0}
    shared = tuple(each for leaf, each in sorted(found.items()) if leaf > 0)
    return Agreement(
        kappa=cohens_kappa(judged.ids[judged.instance[is_shared]], true_ids),
        shared=shared,
        alone=tuple(leaf for leaf in judged.ids[judged.leaves.is_false].tolist() if leaf > 0),
        missed=tuple(label for label in judged.labels if label not in {each.true for each in shared}),
    )


def cohens_kappa(first: np.ndarray, second: np.ndarray) -> float:
    """Cohen's kappa of two (D,) id vectors whose numbers mean nothing: each id of the first stands for one of the
    second, so that most elements agree. (Cohen, "A coefficient of agreement for nominal scales", 1960.)"""
    table = contingency_table(first, second)
    count = int(table.sum())
    rows, columns = linear_sum_assignment(table, maximize=True)
    agree = int(table[rows, columns].sum()) * count
    by_chance = int((table.sum(1)[rows] * table.sum(0)[columns]).sum())
    return 1.0 if by_chance == count**2 else (agree - by_chance) / (count**2 - by_chance)
