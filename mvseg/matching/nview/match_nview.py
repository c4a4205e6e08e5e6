"""Matching by what all views show, from start to finish.

Pairs of views cannot tell apart leaves that share their epipolar lines; a third view can. What the views show along the
rays of each region (`plane_sweep.py`) gives initial partitions (`initialisation.py`); the search (`search.py`) improves
them by how well clusters explain all views (`cluster_scores.py`); what shares a photo with its leaf and is likelier a
stranger than a piece leaves (`pieces.py`); then every id gets a probability (`match_scores.py`), and masks that cover
two instances are found (`merged_masks.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.masks import Masks
from mvseg.matching.affinity import Affinity
from mvseg.matching.links import Links
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.match_scores import collect_evidence, match_scores
from mvseg.matching.nview.merged_masks import find_merged
from mvseg.matching.nview.pieces import part_pieces
from mvseg.matching.nview.plane_sweep import PlaneSweep, rays_per_region, sweep_dilated, sweep_planes
from mvseg.matching.nview.search import search
from mvseg.matching.one_per_view import ViewGraph, link_average, power_iteration
from mvseg.matching.partition import drop_singletons, number_instances
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions
from mvseg.scene import Cameras

Ints = NDArray[np.int64]

DILATIONS = (1, 2, 4, 8)  # reprojection errors that are tried, pixels
PROBE_RAYS = 1500  # tell whether a dilation helps, at least about this many
EXPLAINED, UNEXPLAINED = 0.5, 0.3  # mean score above which the poses are sound; below which the hypotheses are useless


def match_nview(
    regions: Regions,
    cameras: Cameras,
    affinity: Affinity,
    *,
    config: NViewConfig = NViewConfig(),
    residual_px: int | None = None,
    links: Links | None = None,
    progress: bool = False,
) -> Matching:
    """Match the regions of V >= 2 views by what all views show.

    Args:
        regions: D regions in V views, in any order.
        cameras: V cameras.
        affinity: the epipolar weights of the regions.
        config: costs, gains and thresholds.
        residual_px: the reprojection error where it is known, one of DILATIONS; None: estimated.
        links: of the regions. Where what is found without them contradicts one, all of them hold in a second search.
        progress: show progress bars.

    Returns:
        The matching, on the device of the regions. Its method is "one-per-view" where the hypotheses do not explain the
        regions (poses too far off) or there are two views. It is deterministic and does not depend on the order of
        views and regions unless two choices tie exactly. Without regions or edges all ids are -1.
    """
    order = regions.view_index.argsort(stable=True)
    ordered = regions.select(order)
    graph = ViewGraph.of(affinity, regions.view_index, len(cameras)).select(order.cpu().numpy())
    found = find_clusters(ordered, cameras, graph, config=config, residual_px=residual_px, progress=progress)
    scores, clusters = found.scores, found.clusters
    if links is not None and not links.select(order).agree(clusters):
        scores, clusters = search_again(found, links.select(order), progress=progress)
    clusters, chance = part_pieces(scores, clusters)
    evidence = collect_evidence(scores, clusters, found.pairwise)
    report = MatchReport(
        method=found.method,
        has_probabilities=True,
        residual_px=found.residual_px,
        explained=scores.explained(clusters),
        view_explained=torch.from_numpy(scores.explained_per_view(clusters)).float().to(regions.device),
    )
    probabilities = torch.from_numpy(np.minimum(match_scores(evidence), chance)).float()
    masks = Masks.of(ordered.to("cpu"), torch.from_numpy(clusters + 1), probabilities)
    masks = masks.with_merged(find_merged(scores, clusters, ordered)).select(order.argsort().cpu())
    masks = masks.relabel(_final_numbers(masks.instance_ids))
    return Matching(replace(masks.to(regions.device), regions=regions), report)


@dataclass(frozen=True, eq=False)
class FoundClusters:
    """The clusters of D regions that are ordered by view, and what they were found with.

    Attributes:
        clusters: (D,) int64 in [0, K), regions alone included.
        pairwise: (D,) int64, likewise, from the weights alone.
        scores: of the hypotheses.
        residual_px: see `select_dilation`.
        method: "nview", or "one-per-view" where these are the pairwise clusters.
    """

    clusters: Ints
    pairwise: Ints
    scores: ClusterScores
    residual_px: int
    method: str


def find_clusters(
    regions: Regions,
    cameras: Cameras,
    graph: ViewGraph,
    *,
    config: NViewConfig = NViewConfig(),
    residual_px: int | None = None,
    progress: bool = False,
) -> FoundClusters:
    """The clusters that explain all views best, or where hypotheses explain too little, those from the weights alone.

    Args:
        regions: D regions, ordered by view.
        cameras: V cameras.
        graph: their epipolar weights.
        config: costs, gains and thresholds.
        residual_px: the reprojection error where it is known, one of DILATIONS; None: estimated.
        progress: show progress bars.
    """
    pairwise = power_iteration(graph, link_average(graph))
    scores, residual_px = select_dilation(
        regions, cameras, graph, pairwise=pairwise, config=config, residual_px=residual_px, progress=progress
    )
    clusters, method = pairwise, "one-per-view"
    if len(cameras) > 2:
        searched = search(scores, pairwise, progress=progress)
        if scores.explained(searched) >= UNEXPLAINED:
            clusters, method = searched, "nview"
    return FoundClusters(clusters, pairwise, scores, residual_px, method)


def search_again(found: FoundClusters, links: Links, *, progress: bool = False) -> tuple[ClusterScores, Ints]:
    """The clusters that explain all views best and agree with links; and their scores.

    What was found without links is one more start; but each node that links name begins by itself.
    """
    linked = links.hold(found.scores.graph)
    scores, pairwise = found.scores.with_graph(linked), power_iteration(linked, link_average(linked))
    if found.method != "nview":
        return scores, pairwise
    assert linked.node is not None
    start = np.where(linked.is_linked, found.clusters.max() + 1 + linked.node, found.clusters)
    return scores, search(scores, pairwise, more_starts=[start], progress=progress)


def select_dilation(
    regions: Regions,
    cameras: Cameras,
    graph: ViewGraph,
    *,
    pairwise: Ints,
    config: NViewConfig,
    residual_px: int | None = None,
    progress: bool = False,
) -> tuple[ClusterScores, int]:
    """The scores of the plane sweep whose label maps are dilated by the reprojection error, and that error in pixels.

    The error is the least dilation with which the hypotheses explain the pairwise clusters nearly as well as with any;
    a few rays of each region tell that of all but the first. A `residual_px` that is known is not estimated.
    """
    config = config.for_views(len(cameras))

    def score(sweep: PlaneSweep) -> ClusterScores:
        return ClusterScores(sweep, graph, config)

    first = score(sweep_planes(regions, cameras, dilation_px=residual_px or DILATIONS[0], progress=progress))
    explained = [first.explained(pairwise)]
    if residual_px is not None or explained[0] >= EXPLAINED:
        return first, residual_px or DILATIONS[0]
    rays = min(rays_per_region(len(cameras)), -(-PROBE_RAYS // max(len(regions), 1)))
    for sweep in sweep_dilated(regions, cameras, dilations=DILATIONS[1:], rays=rays, progress=progress):
        explained.append(score(sweep).explained(pairwise))
    best = int(np.argmax(np.array(explained) >= max(explained) - 0.05))
    if best == 0:
        return first, DILATIONS[0]
    return score(sweep_planes(regions, cameras, dilation_px=DILATIONS[best], progress=progress)), DILATIONS[best]


def _final_numbers(ids: torch.Tensor) -> torch.Tensor:
    """(K,) int64: number of each instance by its first region; -1 for one with a single region."""
    clusters = ids.numpy() - 1
    ids = number_instances(drop_singletons(clusters))
    _, first = np.unique(clusters, return_index=True)
    return ids[torch.from_numpy(first)]
