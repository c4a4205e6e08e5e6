from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.one_per_view import assign_one_to_one, join_alone, link_average, one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions
from reference import link_average_reference
from synthetic import ball_scene


def ids_of(W: np.ndarray, views: list[int]) -> list[int]:
    graph = ViewGraph(W, np.array(views, np.int64), max(views, default=0) + 1)
    ids: list[int] = one_per_view_clusters(graph).drop_singletons().instance_ids().tolist()
    return ids


def random_weights(views: np.ndarray, seed: int) -> np.ndarray:
    W = np.random.default_rng(seed).random((len(views), len(views)))
    W = (W + W.T) / 2
    W[views[:, None] == views] = 0
    return W


def test_the_whole_view_decides_not_the_single_best_edge() -> None:
    """Agglomeration would take 0.9 first and leave a pair of 0.1; the assignment finds 0.8 + 0.8."""
    W = np.zeros((4, 4))
    W[0, 2], W[0, 3], W[1, 2], W[1, 3] = 0.9, 0.8, 0.8, 0.1
    W += W.T
    views = np.array([0, 0, 1, 1])
    assert link_average(ViewGraph(W, views, 2), 0.2).ids.tolist() == [0, 1, 0, 2]
    assert ids_of(W, views.tolist()) == [1, 2, 2, 1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("stop", [0.0, 0.4, 0.6])
def test_average_linkage_agrees_with_its_definition(seed: int, stop: float) -> None:
    views = np.random.default_rng(seed).integers(0, 4, 14)
    W = random_weights(views, seed)
    linked = link_average(ViewGraph(W, views, 4), stop).ids
    np.testing.assert_array_equal(linked, Clusters.of(link_average_reference(W, views, stop)).ids)


def test_of_equal_weights_the_first_regions_win() -> None:
    W = np.zeros((4, 4))
    W[0, 2] = W[0, 3] = W[1, 2] = W[1, 3] = 0.5
    views = np.array([0, 0, 1, 1])
    assert link_average(ViewGraph(W + W.T, views, 2), 0.2).ids.tolist() == [0, 1, 0, 1]
    assert link_average(ViewGraph(W + W.T, views, 2), stop=0.5).ids.tolist() == [0, 1, 0, 1]  # as large as asked for


def test_assignment_agrees_with_trying_everything() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        gain, alone = rng.random((3, 2)), 0.3
        options = [
            choice
            for choice in itertools.product(range(3), repeat=3)
            if all(sum(c == k for c in choice) <= 1 for k in range(2))
        ]
        best = max(sum(gain[n, c] if c < 2 else alone for n, c in enumerate(choice)) for choice in options)
        chosen = assign_one_to_one(gain, alone)
        assert sum(gain[n, c] if c < 2 else alone for n, c in enumerate(chosen)) == pytest.approx(best)
        assert len(set(chosen.tolist())) == 3


def test_never_two_regions_of_one_view_and_a_second_chance_for_those_alone() -> None:
    for seed in range(5):
        views = np.random.default_rng(seed).integers(0, 5, 40)
        W = random_weights(views, seed)
        pairs = [(i, v) for i, v in zip(ids_of(W, views.tolist()), views, strict=True) if i > 0]
        assert len(pairs) == len(set(pairs))
    # Cluster 0 holds views 0 and 1. Region 2 fits it; 3 is in a taken view; 4 and 5 only fit each other; 6 nothing.
    views, W = np.array([0, 1, 2, 0, 1, 2, 3]), np.zeros((7, 7))
    W[0, 1], W[0, 2], W[1, 2], W[1, 3], W[4, 5], W[6, 0] = 0.9, 0.8, 0.6, 0.9, 0.5, 0.3
    joined = join_alone(ViewGraph(W + W.T, views, 4), Clusters.of(np.array([0, 0, 1, 2, 3, 4, 5])), stop=0.4)
    assert joined.ids.tolist() == [0, 0, 0, 1, 2, 2, 3]
    # Cluster 0 holds views 0 and 1; regions 2 and 3, of one view, both fit it, and only one can join.
    views, W = np.array([0, 1, 2, 2]), np.zeros((4, 4))
    W[0, 1], W[0, 2], W[1, 2], W[0, 3], W[1, 3] = 0.9, 0.6, 0.6, 0.9, 0.5
    joined = join_alone(ViewGraph(W + W.T, views, 3), Clusters.of(np.array([0, 0, 1, 2])), stop=0.4)
    assert joined.ids.tolist() == [0, 0, 1, 0]


def test_balls_are_solved_in_any_order() -> None:
    scene = ball_scene(9, 6, seed=3)

    def ids_of_regions(regions: Regions) -> torch.Tensor:
        return one_per_view_clusters(ViewGraph.of(region_affinity(regions, scene.cameras), regions)).instance_ids()

    ids = ids_of_regions(scene.regions)
    assert matching_metrics(ids, scene.regions.labels).ari == 1
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(0))
    assert matching_metrics(ids_of_regions(scene.regions.select(order)), ids[order]).ari == 1
    assert ids_of(np.zeros((2, 2)), [0, 1]) == [-1, -1]
    assert ids_of(np.zeros((0, 0)), []) == []
