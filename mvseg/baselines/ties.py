"""What the compared matchers share: a tie of weight one per corresponding pair of regions, and SymNMF (Sec. 4.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from mvseg.config import MatchConfig
from mvseg.errors import InputError
from mvseg.matching.affinity import Affinity
from mvseg.matching.match_regions import Matching, mean_affinity
from mvseg.matching.symnmf import cluster_affinity
from mvseg.regions import Regions
from mvseg.scene import Scene


def check_views(regions: Regions, scene: Scene) -> None:
    """Raises InputError: fewer than two views, or regions and scene of different numbers of views."""
    num_views = len(scene.cameras)
    if num_views != regions.num_views:
        raise InputError(f"regions of {regions.num_views} views with {num_views} cameras, expected as many of each")
    if num_views < 2:
        raise InputError("matching needs at least two views, got a single one")


def tie_graph(ties: Tensor, num_regions: int) -> Affinity:
    """The graph in which corresponding regions are tied with weight one (Sec. 4.2).

    Args:
        ties: (T, 2) int64, pairs of regions of different views; order and repetitions mean nothing. A pair that only
            one of its two regions chose weighs as much as one that both chose: the paper has no other weight than one.
        num_regions: D.
    """
    edges = ties.sort(1).values.unique(dim=0)
    return Affinity(edges, torch.ones(len(edges), device=ties.device), num_regions)


def cluster_ties(graph: Affinity, regions: Regions, config: MatchConfig | None, method: str) -> Matching:
    """Instance ids of a graph of ties by SymNMF, the number of instances by Eq. 7.

    Args:
        graph: ties of the D regions.
        regions: whose numbers per view set the default range for the number of instances.
        config: num_instances, search_range, num_restarts and seed are used, as `match_regions` does for symnmf; the
            rest is about the epipolar weights.
        method: what the matching calls itself.

    Returns:
        The matching. Regions without a tie are -1; the scores are the share of a cluster's regions in other views that
        a region is tied to.
    """
    config = config or MatchConfig()
    ids = cluster_affinity(
        graph,
        regions.num_per_view,
        num_instances=config.num_instances,
        search_range=config.search_range,
        num_restarts=config.num_restarts,
        seed=config.seed,
    ).instance_ids
    return Matching(ids, mean_affinity(graph, ids, regions), int(ids.max()) + 1 if len(ids) else 0, method)
