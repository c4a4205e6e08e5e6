"""What the compared matchers share: an edge of weight one per corresponding pair of regions (Sec. 4.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from mvseg.matching.affinity import Affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import matching_of_ids
from mvseg.matching.result import Matching
from mvseg.matching.symnmf import cluster_weights
from mvseg.regions import Regions


def edge_graph(pairs: Tensor, num_regions: int) -> Affinity:
    """The graph in which corresponding regions share an edge of weight one (Sec. 4.2).

    Args:
        pairs: (T, 2) int64, pairs of regions of different views; order and repetitions mean nothing. A pair that only
            one of its two regions chose weighs as much as one that both chose: the paper has no other weight than one.
        num_regions: D.
    """
    edges = pairs.sort(1).values.unique(dim=0)
    return Affinity(edges, torch.ones(len(edges), device=pairs.device), num_regions)


def match_graph(affinity: Affinity, regions: Regions, *, method: str) -> Matching:
    """Cluster any graph of the regions with SymNMF, |k| by Eq. 7; `method` is that of the result's `MatchReport`."""
    clustering = cluster_weights(affinity.to_dense(), regions.num_per_view, MatchConfig())
    return matching_of_ids(clustering.instance_ids, regions, affinity, method=method)
