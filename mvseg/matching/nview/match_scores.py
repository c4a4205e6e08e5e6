"""How sure a match is: the probability that a region's id is right, from the evidence for it.

Two logistic regressions, fitted on simulated development plants of 3 to 20 views and 4 to 32 leaves: of the regions
scored about 0.8, about 80 % are right there (`benchmarks/confidence.py`). A region is right when its cluster is the
largest one of its leaf, and its leaf is the most frequent one of its cluster.

The first regression looks at the region alone, and knows exact poses only. With wrong poses, nearly every region finds
some cluster that explains it well, but the scene tells: its regions are less sure on average, and their clusters differ
from those of the epipolar weights. So the second one, fitted with wrong poses, too, decides how far to believe the
regions of this scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logit

from mvseg.arrays import Ints, Reals
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.partition import Clusters

# Weights of the columns of `features`, in their order, and of those of `scene_features`.
REGION = {"always": 1.24, "score": 1.20, "margin": 2.96, "coverage": -0.69, "weight": 1.26, "partners": -0.90,
          "few partners": -1.59, "fragments": -0.95}  # fmt: skip
SCENE = {"always": -2.889, "region": 0.050, "scene": 0.303, "region times scene": 0.173, "agreement": 2.911}
SCORES, MARGINS = (-0.2, 1.0), (-1.0, 1.5)  # limit: ranges of features on the plants that these were fitted on
SUREST = 0.999, 0.99  # limit: the most that the first regression says of a region, and of a scene


@dataclass(frozen=True, eq=False)
class IdEvidence:
    """The evidence for the ids of D regions.

    Attributes:
        score: (D,) leave-one-out score in the region's cluster.
        margin: (D,) gain of the region's cluster minus that of the best alternative: another cluster, or being alone.
        coverage: (D,) share of the cluster's pixels in other views that are covered by the region.
        weight: (D,) mean epipolar weight to the members in other views.
        num_partners: (D,) int64, members of the cluster in other views; 0 for a region that is alone.
        num_fragments: (D,) int64, members of the cluster in the region's own view, itself included.
        agreement: (D,) share of the regions of other views in this cluster or in the pairwise one that are in both.
    """

    score: Reals
    margin: Reals
    coverage: Reals
    weight: Reals
    num_partners: Ints
    num_fragments: Ints
    agreement: Reals
    num_views: int


def collect_evidence(scores: ClusterScores, clusters: Clusters, pairwise: Clusters) -> IdEvidence:
    """The evidence for the cluster of each region; there is none for regions alone in theirs. `pairwise`, from the
    epipolar weights alone, is a second opinion."""
    sweep, coverages = scores.sweep, scores.coverages(clusters)
    score, own_gain, rival_gain, coverage = (np.zeros(len(clusters.ids)) for _ in range(4))
    for view in np.unique(sweep.view_index).tolist():
        here = sweep.regions_of[view]
        gains = scores.gains(view, clusters.ids, coverages)
        is_own = clusters.ids[here][:, None] == gains.clusters
        score[here] = (gains.score * is_own).sum(1)
        own_gain[here] = (gains.total * is_own).sum(1)
        rival_gain[here] = np.where(is_own, 0, gains.total).max(1, initial=0)
        coverage[here] = (gains.coverage * is_own).sum(1)
    num_partners, num_fragments = _count_partners(clusters.ids, sweep.view_index)
    num_paired, _ = _count_partners(pairwise.ids, sweep.view_index)
    joint = np.unique(np.stack((clusters.ids, pairwise.ids)), axis=1, return_inverse=True)[1]
    num_in_both, _ = _count_partners(joint, sweep.view_index)
    return IdEvidence(
        score=score,
        margin=own_gain - rival_gain,
        coverage=coverage,
        weight=scores.graph.sum_partners(scores.graph.weights, clusters) / np.maximum(num_partners, 1),
        num_partners=num_partners,
        num_fragments=num_fragments,
        agreement=num_in_both / np.maximum(num_partners + num_paired - num_in_both, 1),
        num_views=sweep.num_views,
    )


def _count_partners(clusters: Ints, view_index: Ints) -> tuple[Ints, Ints]:
    place = clusters * (int(view_index.max(initial=0)) + 1) + view_index
    num_fragments = np.bincount(place)[place]
    return np.bincount(clusters)[clusters] - num_fragments, num_fragments


def features(evidence: IdEvidence) -> Reals:
    """(D, 8): 1, and what the probability depends on, clipped to the range seen on the development plants."""
    others = max(evidence.num_views - 1, 1)
    columns = [
        np.ones(len(evidence.score)),
        np.clip(evidence.score, *SCORES),
        np.clip(evidence.margin, *MARGINS),
        np.clip(evidence.coverage, 0, 1),
        np.clip(evidence.weight, 0, 1),
        np.minimum(evidence.num_partners / others, 1),
        1 / np.maximum(evidence.num_partners, 1),
        evidence.num_fragments > 1,
    ]
    return np.stack(columns, 1)


def scene_features(evidence: IdEvidence) -> Reals:
    """(D, 5): 1, log odds of the region, log odds of the scene, their product, and the agreement with the pairwise
    clusters. Log odds are of the first regression, for the region and for its mean over the matched regions."""
    sure = 1 / (1 + np.exp(-(features(evidence) @ list(REGION.values()))))
    is_matched = evidence.num_partners > 0
    mean = float(sure[is_matched].mean()) if is_matched.any() else 0.0
    agreement = evidence.agreement[is_matched].mean() if is_matched.any() else 0.0
    region = logit(np.clip(sure, 1 - SUREST[0], SUREST[0]))
    scene = logit(np.clip(mean, 1 - SUREST[1], SUREST[1]))
    ones = np.ones(len(sure))
    return np.stack([ones, region, scene * ones, region * scene, agreement * ones], 1)


def match_scores(evidence: IdEvidence) -> Reals:
    """(D,) in [0, 1]: the probability that each id is right; 0 for regions that are alone."""
    logit = scene_features(evidence) @ list(SCENE.values())
    return np.where(evidence.num_partners > 0, 1 / (1 + np.exp(-logit)), 0.0)
