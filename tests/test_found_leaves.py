"""Which leaves a set of masks finds, as the benchmarks count them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks are not part of the package

from benchmarks.found_leaves import credit_masks, is_found
from mvseg.regions import Regions, regions_from_label_maps, stack_regions


def make_strips(view_index: list[int], spans: list[tuple[int, int]]) -> Regions:
    """Masks of one row, from one column to another."""
    boxes = [(start, 0, stop, 1) for start, stop in spans]
    crops = [torch.ones(stop - start, dtype=torch.bool) for start, stop in spans]
    return stack_regions(view_index, boxes, crops, labels=range(len(spans)), num_views=2)


def test_the_best_scored_mask_of_a_leaf_finds_it_and_no_other_does() -> None:
    truth = [np.repeat([[4, 0, 7]], 10, axis=1).astype(np.uint16)] * 2  # leaf 4 in columns 0 to 9, leaf 7 in 20 to 29
    spans = [(0, 9), (0, 10), (0, 6), (20, 24), (0, 10)]  # three of leaf 4, too little of leaf 7; leaf 4 in view 1
    masks = make_strips([0, 0, 0, 0, 1], spans)
    credited = credit_masks(masks, torch.tensor([0.5, 0.4, 0.9, 0.8, 0.1]), truth)
    assert credited.tolist() == [0, 0, 4, 0, 4]
    true_regions = regions_from_label_maps(truth)
    assert true_regions.labels.tolist() == [4, 7, 4, 7]
    assert is_found(true_regions, masks, credited).tolist() == [True, False, True, False]


def test_nothing_is_found_by_no_masks() -> None:
    truth = [np.array([[1, 1]], np.uint16)] * 2
    none = make_strips([], [])
    credited = credit_masks(none, torch.zeros(0), truth)
    assert is_found(regions_from_label_maps(truth), none, credited).tolist() == [False, False]
