"""Matching by what all views show, from start to finish.

Pairs of views cannot tell apart leaves that share their epipolar lines; a third view can. What the views show along the
rays of each region (`plane_sweep.py`) gives initial partitions (`initialisation.py`); the search (`search.py`) improves
them by how well clusters explain all views (`cluster_scores.py`); what shares a photo with its leaf and is likelier a
stranger than a piece leaves (`pieces.py`); then every id gets a probability (`match_scores.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from mvseg.masks import Masks
from mvseg.matching.numbers import NVIEW
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.match_scores import collect_evidence, match_scores
from mvseg.matching.nview.pieces import part_pieces
from mvseg.matching.nview.plane_sweep import PlaneSweep, rays_per_region, sweep_dilated, sweep_planes
from mvseg.matching.nview.search import search
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.result import Matching, MatchReport
from mvseg.matching.view_graph import ViewGraph, first_without_links
from mvseg.regions import Regions
from mvseg.scene import Cameras


def match_nview(
    regions: Regions,
    cameras: Cameras,
    graph: ViewGraph,
    *,
    residual_px: int | None = None,
) -> Matching:
    """Match D regions of V >= 2 views, in any order, by what all views show.

    Args:
        graph: the epipolar weights of the regions, and their links.
        residual_px: the reprojection error where it is known, one of `NVIEW.dilations`; None: estimated.

    Returns:
        The matching, on the device of the regions. Its method is "one-per-view" where the hypotheses do not explain the
        regions (poses too far off) or there are two views. It is deterministic and does not depend on the order of
        views and regions unless two choices tie exactly. Without regions or edges all ids are -1.
    """
    order = regions.view_index.argsort(stable=True)
    ordered, graph = regions.select(order), graph.select(order.cpu().numpy())
    best = find_clusters(ordered, cameras, graph, residual_px=residual_px)
    clusters, chance = part_pieces(best.scores, best.clusters)
    evidence = collect_evidence(best.scores, clusters, best.pairwise)
    report = MatchReport(
        method=best.method,
        has_probabilities=True,
        residual_px=best.residual_px,
        explained=best.scores.explained(clusters),
        view_explained=torch.from_numpy(best.scores.explained_per_view(clusters)).float().to(regions.device),
    )
    probabilities = torch.from_numpy(np.minimum(match_scores(evidence), chance)).float()
    masks = Masks.of(ordered.to("cpu"), clusters.instance_ids(), probabilities)
    masks = masks.select(order.argsort().cpu())
    ids = masks.instance_ids.numpy()
    final = Clusters.of(ids).drop_singletons().instance_ids()[torch.from_numpy(np.unique(ids, return_index=True)[1])]
    return Matching(replace(masks.relabel(final).to(regions.device), regions=regions), report)


@dataclass(frozen=True, eq=False)
class FoundClusters:
    """The clusters of D regions that are ordered by view, and what they were found with.

    Attributes:
        clusters: those of one region included.
        pairwise: likewise, from the weights alone, without links.
        residual_px: see `select_dilation`.
        method: "nview", or "one-per-view" where the clusters are from the weights alone.
    """

    clusters: Clusters
    pairwise: Clusters
    scores: ClusterScores
    residual_px: int
    method: str


def find_clusters(
    regions: Regions,
    cameras: Cameras,
    graph: ViewGraph,
    *,
    residual_px: int | None = None,
) -> FoundClusters:
    """The clusters of D regions, ordered by view, that explain all views best, or where hypotheses explain too little,
    those from the weights alone. `residual_px`: see `match_nview`."""
    pairwise = one_per_view_clusters(graph.without_links)
    scores, residual_px = select_dilation(regions, cameras, graph, pairwise=pairwise, residual_px=residual_px)

    def cluster(graph: ViewGraph, unlinked: Clusters | None) -> Clusters:
        scored = replace(scores, graph=graph)
        if unlinked is None:
            return search(scored, pairwise)
        free = Clusters.of(np.where(graph.is_linked, len(unlinked) + graph.node, unlinked.ids))
        return search(scored, one_per_view_clusters(graph), more_starts=[free])

    clusters, method = first_without_links(graph, cluster) if len(cameras) > 2 else pairwise, "nview"
    if len(cameras) < 3 or scores.explained(clusters) < NVIEW.unexplained:
        clusters, method = first_without_links(graph, lambda graph, _: one_per_view_clusters(graph)), "one-per-view"
    return FoundClusters(clusters, pairwise, scores, residual_px, method)


def select_dilation(
    regions: Regions,
    cameras: Cameras,
    graph: ViewGraph,
    *,
    pairwise: Clusters,
    residual_px: int | None = None,
) -> tuple[ClusterScores, int]:
    """The scores of the plane sweep whose label maps are dilated by the reprojection error, and that error in pixels.

    The error is the least dilation with which the hypotheses explain the pairwise clusters nearly as well as with any;
    all dilations but the first are tried on a few rays of each region. A given `residual_px` is not estimated.
    """

    def score(sweep: PlaneSweep) -> ClusterScores:
        return ClusterScores(sweep, graph)

    first = score(sweep_planes(regions, cameras, dilation_px=residual_px or NVIEW.dilations[0]))
    explained = [first.explained(pairwise)]
    if residual_px is not None or explained[0] >= NVIEW.explained:
        return first, residual_px or NVIEW.dilations[0]
    rays = min(rays_per_region(len(cameras)), -(-NVIEW.probe_rays // max(len(regions), 1)))
    for sweep in sweep_dilated(regions, cameras, dilations=NVIEW.dilations[1:], rays=rays):
        explained.append(score(sweep).explained(pairwise))
    best = int(np.argmax(np.array(explained) >= max(explained) - NVIEW.as_good))
    if best == 0:
        return first, NVIEW.dilations[0]
    return score(sweep_planes(regions, cameras, dilation_px=NVIEW.dilations[best])), NVIEW.dilations[best]
