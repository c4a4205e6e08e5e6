"""Two annotators: which leaves both have."""

from __future__ import annotations

import numpy as np
import torch

from mvseg.evaluation.agreement import SharedLeaf, compare_annotators
from mvseg.regions import regions_from_label_maps

LEFT, RIGHT, BELOW = (slice(0, 10), slice(0, 10)), (slice(0, 10), slice(10, 20)), (slice(10, 20), slice(0, 10))


def drawn(*views: dict[int, tuple[slice, slice]]) -> list[np.ndarray]:
    maps = []
    for leaves in views:
        maps.append(np.zeros((20, 20), np.int64))
        for leaf, place in leaves.items():
            maps[-1][place] = leaf
    return maps


def test_leaves_of_two_annotators_are_named_by_both() -> None:
    """One has drawn leaf 7 over eight of ten rows, has put one mask of it to another leaf, and a leaf of his own."""
    rows = (slice(0, 8), slice(0, 10))
    one = drawn({3: rows, 4: RIGHT}, {3: rows, 4: RIGHT}, {3: rows, 4: RIGHT}, {4: rows, 9: BELOW})
    other = drawn({7: LEFT, 5: RIGHT}, {7: LEFT, 5: RIGHT}, {7: LEFT, 5: RIGHT}, {7: LEFT, 6: RIGHT})
    regions = regions_from_label_maps(one)
    found = compare_annotators(regions, regions.labels, other)
    assert found.shared == (SharedLeaf(3, 7, 3 * 80 / 400), SharedLeaf(4, 5, 300 / 380))
    assert (found.alone, found.missed) == ((9,), (6,))
    back = regions_from_label_maps(other)
    again = compare_annotators(back, back.labels, one)
    assert [(each.true, each.leaf) for each in again.shared] == [(4, 5), (3, 7)]
    unmatched = torch.where(regions.labels == 9, -1, regions.labels)
    assert compare_annotators(regions, unmatched, other).alone == ()
