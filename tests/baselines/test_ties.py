from __future__ import annotations

import numpy as np
import torch

from mvseg.baselines.ties import tie_graph
from mvseg.matching.config import MatchConfig
from mvseg.matching.match_regions import match_graph
from mvseg.regions import Regions, regions_from_label_maps


def three_views() -> Regions:
    """Two regions in each of three views: 0 and 1, 2 and 3, 4 and 5."""
    return regions_from_label_maps([np.array([[1, 1, 0, 2, 2]])] * 3)


def test_a_tie_counts_once() -> None:
    graph = tie_graph(torch.tensor([[0, 3], [3, 0], [4, 1], [0, 3]]), 5)
    assert graph.edges.tolist() == [[0, 3], [1, 4]]
    assert graph.weights.tolist() == [1, 1]
    assert tie_graph(torch.zeros(0, 2, dtype=torch.int64), 5).to_dense().shape == (5, 5)


def test_scores_are_the_share_of_partners_that_a_region_is_tied_to() -> None:
    ties = torch.tensor([[0, 2], [0, 4], [2, 4], [1, 3], [3, 5]])  # 1 and 5 are tied only through 3
    found = match_graph(tie_graph(ties, 6), three_views(), MatchConfig(), method="here")
    assert found.instance_ids.tolist() == [1, 2, 1, 2, 1, 2]
    assert found.match_scores.tolist() == [1, 0.5, 1, 1, 1, 0.5]
    assert (found.num_instances, found.method) == (2, "here")


def test_regions_without_a_tie_are_unmatched() -> None:
    config = MatchConfig(num_instances=1)
    found = match_graph(tie_graph(torch.tensor([[0, 2]]), 6), three_views(), config, method="here")
    assert found.instance_ids.tolist() == [1, -1, 1, -1, -1, -1]
    assert found.match_scores.tolist() == [1, 0, 1, 0, 0, 0]
    no_ties = tie_graph(torch.zeros(0, 2, dtype=torch.int64), 6)
    none = match_graph(no_ties, three_views(), MatchConfig(), method="here")
    assert (none.instance_ids.tolist(), none.num_instances) == ([-1] * 6, 0)
