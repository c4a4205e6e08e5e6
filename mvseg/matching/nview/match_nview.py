"""Matching by what all views show, from start to finish.

Pairs of views cannot tell apart leaves that share their epipolar lines; a third view can. What the views show along the
rays of each region (`plane_sweep.py`) gives initial partitions (`initialisation.py`); the search (`search.py`) improves
them by how well clusters explain all views (`cluster_scores.py`); what shares a photo with its leaf and is likelier a
stranger than a piece leaves; then every id gets a probability (`match_scores.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit

from mvseg.arrays import Ints, Reals
from mvseg.masks import Masks
from mvseg.matching.numbers import NVIEW, PIECES
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.match_scores import collect_evidence, match_scores
from mvseg.matching.nview.plane_sweep import rays_per_region, sweep_dilated, sweep_planes
from mvseg.matching.nview.search import search
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.result import Matching, MatchReport
from mvseg.matching.view_graph import ViewGraph, first_without_links
from mvseg.regions import Regions
from mvseg.scene import Cameras

# Several masks of one photo in one cluster are pieces of one leaf, or a leaf and a stranger: a leaf that only one photo
# shows fits another leaf along its rays. So a second mask of one photo must be as likely a piece as this scene's masks
# are in pieces, and explained by the cluster nearly as well as the first.
# fitted: python -m benchmarks.pieces: weights of the columns of `piece_features`, in their order.
PIECE = {"always": 1.28, "other pieces": 0.84, "score": 3.69, "coverage": 4.37, "weight": -3.93}


def match_nview(regions: Regions, cameras: Cameras, graph: ViewGraph, *, residual_px: int | None = None) -> Matching:
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
    back = order.argsort().cpu().numpy()
    ids = Clusters.of(clusters.ids[back]).drop_singletons().instance_ids().to(regions.device)
    probabilities = torch.from_numpy(np.minimum(match_scores(evidence), chance)[back]).float().to(regions.device)
    return Matching(Masks.of(regions, ids, probabilities * (ids > 0)), report)


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
    regions: Regions, cameras: Cameras, graph: ViewGraph, *, residual_px: int | None = None
) -> FoundClusters:
    """The clusters of D regions, ordered by view, that explain all views best, or where hypotheses explain too little
    of those from the weights alone, these: a search among wrong hypotheses finds clusters that these explain well.
    `residual_px`: see `match_nview`."""
    pairwise = one_per_view_clusters(graph.without_links)
    scores, residual_px = select_dilation(regions, cameras, graph, pairwise=pairwise, residual_px=residual_px)

    def cluster(graph: ViewGraph, unlinked: Clusters | None) -> Clusters:
        scored = replace(scores, graph=graph)
        if unlinked is None:
            return search(scored, pairwise)
        free = Clusters.of(np.where(graph.is_linked, len(unlinked) + graph.node, unlinked.ids))
        return search(scored, one_per_view_clusters(graph), more_starts=[free])

    if len(cameras) < 3 or scores.explained(pairwise) < NVIEW.unexplained:
        clusters = first_without_links(graph, lambda graph, _: one_per_view_clusters(graph))
        return FoundClusters(clusters, pairwise, scores, residual_px, "one-per-view")
    return FoundClusters(first_without_links(graph, cluster), pairwise, scores, residual_px, "nview")


def select_dilation(
    regions: Regions, cameras: Cameras, graph: ViewGraph, *, pairwise: Clusters, residual_px: int | None = None
) -> tuple[ClusterScores, int]:
    """The scores of the plane sweep whose label maps are dilated by the reprojection error, and that error in pixels.

    The error is the least dilation with which the hypotheses explain the pairwise clusters nearly as well as with any;
    all dilations but the first are tried on a few rays of each region. A given `residual_px` is not estimated.
    """
    dilation_px = residual_px or NVIEW.dilations[0]
    scores = ClusterScores(sweep_planes(regions, cameras, dilation_px=dilation_px), graph)
    explained = [scores.explained(pairwise)]
    if residual_px is None and explained[0] < NVIEW.explained:
        rays = min(rays_per_region(len(cameras)), -(-NVIEW.probe_rays // max(len(regions), 1)))
        for sweep in sweep_dilated(regions, cameras, dilations=NVIEW.dilations[1:], rays=rays):
            explained.append(ClusterScores(sweep, graph).explained(pairwise))
        if best := int(np.argmax(np.array(explained) >= max(explained) - NVIEW.as_good)):
            dilation_px = NVIEW.dilations[best]
            scores = ClusterScores(sweep_planes(regions, cameras, dilation_px=dilation_px), graph)
    return scores, dilation_px


def part_pieces(scores: ClusterScores, clusters: Clusters) -> tuple[Clusters, Reals]:
    """Take strangers out of their clusters, so that they are alone; links of the user stay. Returns the clusters, those
    of one region included, and (D,) float64: P(a remaining piece shows the leaf of its cluster); 1 for all others."""
    chance = np.ones(len(clusters.ids))
    rows, features = piece_features(scores, clusters)
    chance[rows] = expit(features @ list(PIECE.values()))
    leaves = (chance < PIECES.least) & ~scores.graph.is_joined
    parted = np.where(leaves, len(clusters) + np.arange(len(leaves)), clusters.ids)
    return Clusters.of(parted), np.where(leaves, 1.0, chance)


def piece_features(scores: ClusterScores, clusters: Clusters) -> tuple[Ints, Reals]:
    """The P regions that are not the best one of their cluster in their view, by leave-one-out score.

    Returns:
        (P,) int64 rows, and (P, 5) float64: 1; the logarithm of the share of all other places (a cluster in a view)
        that have several regions, half a place counted in any case; the score as a share of the best one's; the share
        of the cluster's pixels in other views that show the region; and its mean epipolar weight to the members there,
        which is low for a piece.
    """
    place = clusters.ids * scores.sweep.num_views + scores.sweep.view_index
    count = np.bincount(place, minlength=1)
    num_split, num_places = int((count > 1).sum()), len(np.unique(place[~clusters.is_alone]))
    own = scores.own(clusters)
    several = np.flatnonzero(count[place] > 1)
    order = several[np.lexsort((several, -own[several], place[several]))]
    is_best = np.diff(place[order], prepend=-1) != 0
    best = order[is_best][is_best.cumsum() - 1]  # of the place of each
    rows, best = order[~is_best], best[~is_best]
    share = np.log((num_split - 0.5) / max(num_places, 1)) if len(rows) else 0.0
    ratio = np.clip(own[rows] / np.maximum(own[best], PIECES.least_score), 0, 1)
    coverage = np.clip(scores.coverages(clusters)[clusters.ids[rows], rows], 0, 1) if len(rows) else np.zeros(0)
    partners = np.maximum(scores.graph.sum_partners(np.ones_like(scores.graph.weights), clusters), 1)
    weight = scores.graph.sum_partners(scores.graph.weights, clusters) / partners
    return rows, np.column_stack((np.ones(len(rows)), np.full(len(rows), share), ratio, coverage, weight[rows]))
