"""Partitions: numbering, and the unmatched."""

from __future__ import annotations

import numpy as np
import torch

from mvseg.matching.partition import Clusters, members_of, separate_unmatched


def test_clusters_are_numbered_from_0_and_instances_from_1_by_their_first_member() -> None:
    clusters = Clusters.of(np.array([7, 7, 3, -1, 9, 3, -5]))
    assert clusters.ids.tolist() == [0, 0, 1, -1, 2, 1, -1]
    assert clusters.instance_ids().tolist() == [1, 1, 2, -1, 3, 2, -1]
    assert clusters.instance_ids().dtype == torch.int64
    assert [each.tolist() for each in clusters.members] == [[0, 1], [2, 5], [4]]
    assert (len(clusters), clusters.sizes.tolist()) == (3, [2, 2, 1])
    assert clusters.is_alone.tolist() == [False, False, False, True, True, False, True]


def test_numbering_is_idempotent_and_keeps_the_partition() -> None:
    assert Clusters.of(np.array([-1, -1])).ids.tolist() == [-1, -1]
    none = Clusters.of(np.zeros(0, np.int64))
    assert (none.ids.tolist(), len(none), none.members, none.is_alone.tolist()) == ([], 0, [], [])
    assert none.instance_ids().tolist() == none.drop_singletons().ids.tolist() == []
    numbers = np.random.default_rng(0).integers(-1, 9, 50)
    once = Clusters.of(numbers).ids
    np.testing.assert_array_equal(Clusters.of(once).ids, once)
    together = (numbers[:, None] == numbers) & (numbers >= 0)
    np.testing.assert_array_equal((once[:, None] == once) & (once >= 0), together)


def test_members_are_those_of_the_definition() -> None:
    members = members_of(np.array([2, -1, 0, 2]), 4)
    assert [each.tolist() for each in members] == [[2], [], [0, 3], []]
    assert members_of(np.zeros(0, np.int64), 0) == []
    dropped = Clusters.of(np.array([0, 1, 0, 2])).drop_singletons()
    assert dropped.ids.tolist() == [0, -1, 0, -1]
    apart = separate_unmatched(dropped.ids)
    assert apart[0] == apart[2] == 0
    assert len({apart[0], apart[1], apart[3]}) == 3
    np.testing.assert_array_equal(Clusters.of(apart).drop_singletons().ids, [0, -1, 0, -1])
