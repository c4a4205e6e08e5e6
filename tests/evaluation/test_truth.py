"""Which true instance a mask shows, against counting by hand."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.found_leaves import tied_instances
from mvseg.evaluation.truth import true_instance, true_instances
from mvseg.regions import regions_from_label_maps

TRUTH = np.array([[0, 0, 3, 3], [0, 65535, 65535, 3]], np.uint16)


def test_the_instance_of_a_mask_is_the_label_under_most_of_it() -> None:
    assert true_instance(TRUTH, np.array([[0, 1, 1, 1], [0, 0, 0, 0]])) == 3
    assert true_instance(TRUTH, np.array([[1, 1, 1, 0], [0, 0, 0, 0]])) == 0
    assert true_instance(TRUTH, np.array([[0, 0, 0, 0], [0, 1, 1, 1]])) == 65535
    assert true_instance(TRUTH, np.zeros((2, 4))) == 0
    outgrown = np.array([[1, 1, 1, 0], [0, 0, 0, 0]])
    assert true_instance(TRUTH, outgrown, count_background=False) == 3
    assert true_instance(TRUTH, np.array([[1, 1, 0, 0], [0, 0, 0, 0]]), count_background=False) == 0
    regions = regions_from_label_maps([np.array([[7, 7, 0, 0], [0, 0, 0, 0]]), np.array([[0, 0, 8, 8], [0, 0, 0, 9]])])
    assert true_instances(regions, [TRUTH, TRUTH]).tolist() == [0, 3, 3]
    assert true_instances(regions, [TRUTH, np.zeros_like(TRUTH)]).tolist() == [0, 0, 0]


def test_a_region_is_tied_to_the_instance_that_it_covers_well() -> None:
    half, too_large = np.array([[0, 0, 5, 5], [0, 0, 0, 0]]), np.array([[5, 5, 5, 5], [5, 5, 5, 5]])
    regions = regions_from_label_maps([half, too_large])
    assert tied_instances(regions, [TRUTH, TRUTH]).tolist() == [3, 0]  # IoU 2/3 and 3/8
    assert tied_instances(regions, [TRUTH, TRUTH], min_iou=0.7).tolist() == [0, 0]
    ignored = regions_from_label_maps([np.array([[0, 0, 0, 0], [0, 4, 4, 0]])])
    assert tied_instances(ignored, [TRUTH]).tolist() == [0]
    nothing = regions_from_label_maps([np.zeros((2, 4), int)])
    assert true_instances(nothing, [TRUTH]).shape == tied_instances(nothing, [TRUTH]).shape == torch.Size([0])
