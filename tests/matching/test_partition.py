"""Partitions: numbering, and the unmatched."""

from __future__ import annotations

import numpy as np
import torch

from mvseg.matching.partition import drop_singletons, number_instances, renumber, separate_unmatched


def test_clusters_are_numbered_from_0_and_instances_from_1_by_their_first_member() -> None:
    clusters = np.array([7, 7, 3, -1, 9, 3, -5])
    assert renumber(clusters).tolist() == [0, 0, 1, -1, 2, 1, -1]
    assert number_instances(clusters).tolist() == [1, 1, 2, -1, 3, 2, -1]
    assert number_instances(clusters).dtype == torch.int64
    assert renumber(np.array([-1, -1])).tolist() == [-1, -1]
    assert renumber(np.zeros(0, np.int64)).tolist() == number_instances(np.zeros(0, np.int64)).tolist() == []


def test_renumbering_is_idempotent_and_keeps_the_partition() -> None:
    clusters = np.random.default_rng(0).integers(-1, 9, 50)
    once = renumber(clusters)
    np.testing.assert_array_equal(renumber(once), once)
    together = (clusters[:, None] == clusters) & (clusters >= 0)
    np.testing.assert_array_equal((once[:, None] == once) & (once >= 0), together)


def test_regions_alone_are_unmatched_and_back() -> None:
    clusters = np.array([0, 1, 0, 2])
    dropped = drop_singletons(clusters)
    assert dropped.tolist() == [0, -1, 0, -1]
    apart = separate_unmatched(dropped)
    assert apart[0] == apart[2] == 0
    assert len({apart[0], apart[1], apart[3]}) == 3
    np.testing.assert_array_equal(drop_singletons(renumber(apart)), [0, -1, 0, -1])
