"""Several masks of one photo in one cluster: pieces of one leaf, or a leaf and a stranger.

A leaf that only one photo shows fits another leaf along its rays. So a second mask of one photo must be as likely a
piece as this scene's masks are in pieces, and explained by the cluster nearly as well as the first. A logistic
regression, fitted by `python benchmarks/pieces.py`, says how likely.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from mvseg.arrays import Ints, Reals
from mvseg.matching.numbers import PIECES
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.partition import Clusters

# Weights of the columns of `piece_features`, in their order.
PIECE = {"always": 1.28, "other pieces": 0.84, "score": 3.69, "coverage": 4.37, "weight": -3.93}


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
