"""Two questions, each answered by a probability: does this mask show this leaf (q), and is this candidate a leaf (P)?

Logistic regressions of few features. Their numbers stand in `FITTED`, and `python -m benchmarks.choice` fits them by
maximum likelihood. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit, logit
from torch import Tensor

from mvseg.masks import Masks
from mvseg.verification.candidates import Candidates
from mvseg.verification.evidence import Evidence, Floats, Ints
from mvseg.verification.numbers import CHOICE


@dataclass(frozen=True)
class LeafScores:
    """Log odds are sums of terms, or of features in their order, times their weights.

    Attributes:
        shows: weights of `TERMS` for a mask to show a candidate with a surface.
        matched: the same for a candidate without one.
        leaf: weights for a candidate with a surface to be a leaf: see `leaf_features`.
        leaf_matched: the same for a candidate without one, by the first four of these features.
    """

    shows: dict[str, float]
    matched: dict[str, float]
    leaf: dict[str, float]
    leaf_matched: dict[str, float]


FITTED = LeafScores(
    shows={"always": 0.656, "detection score": 0.314, "claimed": 1.431, "visible": 0.665},
    matched={"always": -1.632, "detection score": 0.958, "match score": 0.897},
    leaf={"always": -2.385, "shown": 4.382, "number": 0.913, "detection score": 1.153, "length": 1.157, "fit": 0.387},
    leaf_matched={"always": -0.732, "shown": 1.986, "number": 1.290, "detection score": 0.928},
)


@dataclass(frozen=True, eq=False)
class ClearLeaves:
    """Measures of the clear leaves of one plant, by which its other candidates are judged: a plant that the detector
    has not learned scores low everywhere.

    Attributes:
        score: median log odds of the detection scores of their masks.
        length: median, world units.
    """

    score: float
    length: float


@dataclass(frozen=True, eq=False)
class Pairs:
    """D masks and K candidates, and all that terms of q follow from.

    Attributes:
        scores: (D,) detection scores.
    """

    candidates: Candidates
    evidence: Evidence
    scores: Floats


def always(pairs: Pairs) -> Floats:
    """(D, K) 1."""
    return np.ones_like(pairs.evidence.visible)


def detector(pairs: Pairs) -> Floats:
    """(D, K) log odds of the detection score."""
    return np.broadcast_to(log_odds(pairs.scores)[:, None], pairs.evidence.visible.shape)


def claimed(pairs: Pairs) -> Floats:
    """(D, K) log odds of `Evidence.claimed`."""
    return log_odds(pairs.evidence.claimed)


def visible(pairs: Pairs) -> Floats:
    """(D, K) log odds of `Evidence.visible`."""
    return log_odds(pairs.evidence.visible)


def matcher(pairs: Pairs) -> Floats:
    """(D, K) log odds of the match score."""
    return log_odds(np.nan_to_num(pairs.candidates.matched))


TERMS: dict[str, Callable[[Pairs], Floats]] = {
    "always": always, "detection score": detector, "claimed": claimed, "visible": visible, "match score": matcher
}  # fmt: skip


def sum_terms(weights: Mapping[str, float], pairs: Pairs) -> Floats:
    """(D, K) log odds: each term that has a weight, times this; their order does not matter."""
    rows = [weight * TERMS[name](pairs) for name, weight in sorted(weights.items())]
    return np.asarray(sum(rows), np.float64)


def show_chances(pairs: Pairs, fitted: LeafScores = FITTED) -> Floats:
    """(D, K) q: how likely each mask shows each candidate. Without a surface, only the masks that were matched to a
    candidate can; with one, those that lie in its image."""
    candidates = pairs.candidates
    by_matching = np.where(np.isnan(candidates.matched), -np.inf, sum_terms(fitted.matched, pairs))
    by_surface = np.where(pairs.evidence.claimed > 0, sum_terms(fitted.shows, pairs), -np.inf)
    return np.asarray(expit(np.where(candidates.has_surface, by_surface, by_matching)), np.float64)


def leaf_chances(candidates: Candidates, features: Floats, fitted: LeafScores = FITTED) -> Floats:
    """(K,) P: how likely each candidate is a leaf, and no stem."""
    by_surface = expit(features @ list(fitted.leaf.values()))
    by_masks = expit(features[:, : len(fitted.leaf_matched)] @ list(fitted.leaf_matched.values()))
    chances: Floats = np.where(candidates.has_surface, by_surface * (1 - candidates.stem), by_masks)
    return chances


def leaf_features(
    candidates: Candidates, best: Floats, sure: Floats, *, share: Floats, clear: ClearLeaves | None
) -> tuple[Floats, ClearLeaves]:
    """(K, 6): 1; the mean q of the best masks over the views, weighted by what each shows of the surface; the logarithm
    of the sum of q, plus 0.1; the mean log odds of their detection scores, above that of clear leaves; the logarithm
    of the length, over theirs, 0 for longer ones (pieces are short); and the log odds of `Candidates.fits`.

    Args:
        best: (V, K) q of the best mask of each.
        sure: (V, K) log odds of its detection score.
        share: (V, K), see `Evidence`.
        clear: None: the clear leaves are found among these candidates.
    """
    weight = np.where(candidates.has_surface, share, best > 0)
    mean_q = (weight * best).sum(0) / np.maximum(weight.sum(0), 1e-9)
    number, lengths = best.sum(0), candidates.lengths
    score = (best * sure).sum(0) / np.maximum(number, 1e-9)
    if clear is None:
        is_clear = mean_q >= min(CHOICE.clear, mean_q.max(initial=0))
        known = lengths[is_clear & candidates.has_surface]
        clear = ClearLeaves(float(np.median(score[is_clear])), float(np.median(known)) if len(known) else 1.0)
    relative = np.log(np.maximum(np.where(candidates.has_surface, lengths, clear.length), 1e-12) / clear.length)
    relative = np.minimum(relative, 0.0)
    fits = log_odds(candidates.fits)
    columns = np.ones_like(mean_q), mean_q, np.log(number + CHOICE.some), score - clear.score, relative, fits
    return np.stack(columns, 1), clear


def best_masks(q: Floats, rows_of_views: Sequence[Ints]) -> tuple[Floats, Ints]:
    """(V, K) the largest q (D, K) of each candidate in each view, and the row of its mask; 0 and row 0 in views without
    masks."""
    best, row = np.zeros((len(rows_of_views), q.shape[1])), np.zeros((len(rows_of_views), q.shape[1]), np.int64)
    for view, rows in enumerate(rows_of_views):
        if len(rows):
            first = q[rows].argmax(0)
            best[view], row[view] = q[rows][first, np.arange(q.shape[1])], rows[first]
    return best, row


@dataclass(frozen=True)
class Rating:
    """Score of a pass, to compare passes over the same photos of one plant.

    Attributes:
        agreed_area: pixels, see `rate_pass`.
        expected: expected number of correct masks, E.
        num_leaves: accepted leaves.
    """

    agreed_area: float
    expected: float
    num_leaves: int


def rate_pass(
    masks: Masks, probabilities: Mapping[int, float], *, pixel: float, colored: Tensor | None = None
) -> Rating:
    """Rate a pass by its agreed area: the expected area of the correct masks, within a rim of one pixel of the
    detector, times the expected number of correct masks of a leaf, as a share of the views.

    For one plant and the same views it orders sizes and weights nearly as the truth does (docs/notes/detector.md). The
    number of correct masks alone does not: a leaf in halves has twice as many. Halves mix their ids, so that each has
    masks in fewer views. Pixels without leaf colour count against a mask: all views agree about a plant with its wall,
    too.

    Args:
        masks: D masks with ids whose match scores are q.
        probabilities: {instance id: P}.
        pixel: width of a pixel of the detector, in pixels of the photos. Where it is large, edges are coarse, and views
            agree for that alone.
        colored: (D,) share of each mask that has leaf colour, see `colored_shares`; None: all of it.
    """
    num_leaves = len(masks.instance_ids[masks.instance_ids > 0].unique())
    chances = torch.zeros(max([masks.num_instances, *probabilities]) + 1, dtype=torch.float64)
    for instance, chance in probabilities.items():
        chances[instance] = chance
    is_correct = chances[masks.instance_ids.clamp(min=0).cpu()] * masks.match_scores.cpu().double()
    within = (masks.regions.areas.cpu().double().sqrt() - 2 * pixel).clamp(min=0).square()
    net = within if colored is None else within * (2 * colored - 1)
    expected = float(is_correct.sum())
    area = float((is_correct * net).sum().clamp(min=0)) * expected / max(num_leaves * masks.regions.num_views, 1)
    return Rating(round(area, CHOICE.digits), round(expected, CHOICE.digits), num_leaves)


def order_ratings(ratings: Sequence[Rating]) -> list[int]:
    """Indices of ratings, the best one first: by the agreed area; of equals, the first.

    The area alone has a degenerate optimum: the whole plant as one leaf. So passes with too few leaves
    (`CHOICE.least_leaves`) or too few correct masks (`CHOICE.least_expected`) come last.
    """
    most = max((each.expected for each in ratings), default=0.0)
    is_answer = [
        each.num_leaves >= CHOICE.least_leaves and each.expected >= CHOICE.least_expected * most for each in ratings
    ]
    return sorted(range(len(ratings)), key=lambda index: (not is_answer[index], -ratings[index].agreed_area))


def log_odds(values: Floats) -> Floats:
    """Log odds of shares and scores; NaN, for a mask that no detector scored, counts as one half."""
    least = CHOICE.least_distance
    odds: Floats = logit(np.clip(np.nan_to_num(values, nan=0.5), least, 1 - least))
    return odds
