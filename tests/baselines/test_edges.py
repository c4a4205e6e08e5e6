from __future__ import annotations

import numpy as np
import torch

from benchmarks.baselines.edges import edge_graph
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_graph
from mvseg.matching.result import Matching
from mvseg.regions import Regions, regions_from_label_maps

NO_PAIRS = torch.zeros(0, 2, dtype=torch.int64)


def three_views() -> Regions:
    """Two regions in each of three views: 0 and 1, 2 and 3, 4 and 5."""
    return regions_from_label_maps([np.array([[1, 1, 0, 2, 2]])] * 3)


def clusters(matching: Matching) -> list[list[int]]:
    ids = matching.instance_ids
    return sorted((ids == instance).nonzero()[:, 0].tolist() for instance in ids[ids > 0].unique())


def test_a_pair_counts_once() -> None:
    graph = edge_graph(torch.tensor([[0, 3], [3, 0], [4, 1], [0, 3]]), 5)
    assert graph.edges.tolist() == [[0, 3], [1, 4]]
    assert graph.weights.tolist() == [1, 1]
    assert edge_graph(NO_PAIRS, 5).to_dense().shape == (5, 5)


def test_scores_are_the_share_of_partners_that_a_region_has_an_edge_to() -> None:
    pairs = torch.tensor([[0, 2], [0, 4], [2, 4], [1, 3], [3, 5]])  # 1 and 5 are connected only through 3
    matching = match_graph(edge_graph(pairs, 6), three_views(), MatchConfig(), method="here")
    assert clusters(matching) == [[0, 2, 4], [1, 3, 5]]
    assert matching.match_scores.tolist() == [1, 0.5, 1, 1, 1, 0.5]
    assert (matching.num_instances, matching.report.method) == (2, "here")


def test_regions_without_an_edge_are_unmatched() -> None:
    config = MatchConfig(num_instances=1)
    matching = match_graph(edge_graph(torch.tensor([[0, 2]]), 6), three_views(), config, method="here")
    assert clusters(matching) == [[0, 2]]
    assert (matching.instance_ids == -1).tolist() == [False, True, False, True, True, True]
    assert matching.match_scores.tolist() == [1, 0, 1, 0, 0, 0]
    none = match_graph(edge_graph(NO_PAIRS, 6), three_views(), MatchConfig(), method="here")
    assert (none.instance_ids.tolist(), none.num_instances) == ([-1] * 6, 0)
