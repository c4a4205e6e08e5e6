"""Two questions, each answered by a probability: does this mask show this leaf (q), and is this candidate a leaf (P)?

Logistic regressions of few features. Their numbers stand in `FITTED`, and `python -m benchmarks.choice` fits them by
maximum likelihood. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.special import expit, logit
from torch import Tensor

from mvseg.arrays import Floats, Ints
from mvseg.masks import Masks
from mvseg.verification.candidates import Candidates
from mvseg.verification.evidence import Evidence
from mvseg.verification.mask_colors import MaskColors
from mvseg.verification.numbers import CHOICE


@dataclass(frozen=True)
class LeafScores:
    """Weights of the log odds' terms, by name.

    Attributes:
        shows, matched: of `TERMS`, for a mask to show a candidate with a surface, and without one.
        leaf, leaf_matched: of `LEAF_TERMS`, for a candidate with a surface to be a leaf, and without one.
    """

    shows: dict[str, float]
    matched: dict[str, float]
    leaf: dict[str, float]
    leaf_matched: dict[str, float]


# The weights of "color" and "stem" are chosen: the plants of the fit have nothing beside them that is no leaf, and no
# stem among likely leaves; "color" at 0.5 to 3 loses no right leaf of theirs (docs/notes/detector.md).
FITTED = LeafScores(
    shows={"always": 0.656, "detection score": 0.314, "claimed": 1.431, "visible": 0.665},
    matched={"always": -1.632, "detection score": 0.958, "match score": 0.897},
    leaf={
        "always": -2.385,
        "shown": 4.382,
        "number": 0.913,
        "detection score": 1.153,
        "length": 1.157,
        "fit": 0.387,
        "color": 2.0,
        "stem": 2.0,
    },
    leaf_matched={"always": -0.732, "shown": 1.986, "number": 1.290, "detection score": 0.928, "color": 2.0},
)


@dataclass(frozen=True, eq=False)
class Pairs:
    """D masks, with detection scores (D,), and K candidates: all that terms of q follow from."""

    candidates: Candidates
    evidence: Evidence
    scores: Floats


# (D, K) each
TERMS: dict[str, Callable[[Pairs], Floats]] = {
    "always": lambda pairs: np.ones_like(pairs.evidence.visible),
    "detection score": lambda pairs: np.broadcast_to(log_odds(pairs.scores)[:, None], pairs.evidence.visible.shape),
    "claimed": lambda pairs: log_odds(pairs.evidence.claimed),
    "visible": lambda pairs: log_odds(pairs.evidence.visible),
    "match score": lambda pairs: log_odds(np.nan_to_num(pairs.candidates.matched)),
}


def sum_terms(weights: Mapping[str, float], terms: Mapping[str, Floats]) -> Floats:
    """Log odds: each term that has a weight, times this."""
    return np.asarray(sum(weight * terms[name] for name, weight in sorted(weights.items())), np.float64)


def show_chances(pairs: Pairs, fitted: LeafScores = FITTED) -> Floats:
    """(D, K) q: with a surface, of masks in its image; without one, of the masks that were matched to the candidate."""
    candidates, terms = pairs.candidates, {name: term(pairs) for name, term in TERMS.items()}
    by_matching = np.where(np.isnan(candidates.matched), -np.inf, sum_terms(fitted.matched, terms))
    by_surface = np.where(pairs.evidence.claimed > 0, sum_terms(fitted.shows, terms), -np.inf)
    return np.asarray(expit(np.where(candidates.has_surface, by_surface, by_matching)), np.float64)


@dataclass(frozen=True, eq=False)
class ClearLeaves:
    """Measures of the clear leaves of one plant, by which its other candidates are judged: a plant that the detector
    has not learned scores low everywhere, and a red one has red leaves.

    Attributes:
        score: median log odds of the detection scores of their masks.
        length: median, world units.
        color: (K,) of each candidate, see `MaskColors.likeness`.
    """

    score: float
    length: float
    color: Floats


@dataclass(frozen=True, eq=False)
class Met:
    """K candidates as the choice meets them, and all that terms of P follow from.

    Attributes:
        best: (V, K) q of the best mask of each that is free.
        row: (V, K) its row.
        scores: (D,) log odds of detection scores.
        share: (V, K), see `Evidence`.
    """

    candidates: Candidates
    best: Floats
    row: Ints
    scores: Floats
    share: Floats

    @cached_property
    def number(self) -> Floats:
        """(K,) expected number of right masks."""
        return np.asarray(self.best.sum(0), np.float64)

    @cached_property
    def coverage(self) -> Floats:
        """(K,) mean q of the best masks over the views, weighted by what each must show of the surface."""
        weight = np.where(self.candidates.has_surface, self.share, self.best > 0)
        return np.asarray((weight * self.best).sum(0) / np.maximum(weight.sum(0), 1e-9), np.float64)

    def mean(self, values: Floats) -> Floats:
        """(K,) mean of values (D,) of the best masks, weighted by q."""
        return np.asarray((self.best * values[self.row]).sum(0) / np.maximum(self.number, 1e-9), np.float64)

    def find_clear(self, colors: MaskColors | None) -> ClearLeaves:
        """The clear leaves among these candidates."""
        is_clear = self.coverage >= min(CHOICE.clear, self.coverage.max(initial=0))
        lengths = self.candidates.lengths[is_clear & self.candidates.has_surface]
        color = np.zeros(len(is_clear))
        if colors is not None:
            weights = np.zeros((len(self.scores), len(is_clear)))
            np.add.at(weights, (self.row, np.arange(len(is_clear))), self.best)
            color = colors.likeness(weights, is_clear)
        score = float(np.median(self.mean(self.scores)[is_clear]))
        return ClearLeaves(score, float(np.median(lengths)) if len(lengths) else 1.0, color)


def _length(met: Met, clear: ClearLeaves) -> Floats:
    """Pieces are short."""
    lengths = np.where(met.candidates.has_surface, met.candidates.lengths, clear.length)
    return np.minimum(np.log(np.maximum(lengths, 1e-12) / clear.length), 0.0)


# (K,) each
LEAF_TERMS: dict[str, Callable[[Met, ClearLeaves], Floats]] = {
    "always": lambda met, _: np.ones_like(met.number),
    "shown": lambda met, _: met.coverage,
    "number": lambda met, _: np.log(met.number + CHOICE.some),
    "detection score": lambda met, clear: met.mean(met.scores) - clear.score,
    "length": _length,
    "fit": lambda met, _: log_odds(met.candidates.fits),
    "color": lambda _, clear: np.minimum(clear.color, 0.0),
    "stem": lambda met, _: np.log(1 - np.minimum(met.candidates.stem, 1 - CHOICE.least_distance)),
}


def leaf_chances(met: Met, clear: ClearLeaves, fitted: LeafScores = FITTED) -> tuple[Floats, Floats]:
    """(K,) P, how likely each candidate is a leaf; and (T, K) the terms."""
    terms = {name: term(met, clear) for name, term in LEAF_TERMS.items()}
    by_surface, by_masks = (sum_terms(weights, terms) for weights in (fitted.leaf, fitted.leaf_matched))
    odds = np.where(met.candidates.has_surface, by_surface, by_masks)
    return np.asarray(expit(odds), np.float64), np.stack(list(terms.values()))


def best_masks(q: Floats, rows_of_views: Sequence[Ints]) -> tuple[Floats, Ints]:
    """(V, K) the largest q (D, K) of each candidate in each view, and the row of its mask; 0 in views without masks."""
    best, row = np.zeros((len(rows_of_views), q.shape[1])), np.zeros((len(rows_of_views), q.shape[1]), np.int64)
    for view, rows in enumerate(rows_of_views):
        if len(rows):
            first = q[rows].argmax(0)
            best[view], row[view] = q[rows][first, np.arange(q.shape[1])], rows[first]
    return best, row


@dataclass(frozen=True)
class Rating:
    """Score of a pass: agreed area in pixels, see `rate_pass`; expected correct masks, E; number of leaves."""

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
        pixel: width of a pixel of the detector, in pixels of the photos: where it is large, views agree for that alone.
        colored: (D,) share of each mask that has leaf colour; None: all of it.
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
    """Indices of the answers among ratings, the best one first, then by the agreed area.

    The best one is the first whose agreed area no other exceeds by `CHOICE.growth`: less is chance. The area alone has
    a degenerate optimum, the whole plant as one leaf; so passes with too few leaves (`CHOICE.least_leaves`) or correct
    masks (`CHOICE.least_expected`) are no answers, unless all are so.
    """
    least = CHOICE.least_expected * max((each.expected for each in ratings), default=0.0)
    is_answer = [each.num_leaves >= CHOICE.least_leaves and each.expected >= least for each in ratings]
    answers = np.flatnonzero(is_answer if any(is_answer) else np.ones(len(ratings)))
    areas = np.array([each.agreed_area for each in ratings])
    first = next(iter(answers[CHOICE.growth * areas[answers] >= areas[answers].max(initial=0.0)]), None)
    return sorted(answers.tolist(), key=lambda index: (index != first, -areas[index]))


def log_odds(values: Floats) -> Floats:
    """Log odds of shares and scores; NaN, for a mask that no detector scored, counts as one half."""
    least = CHOICE.least_distance
    odds: Floats = logit(np.clip(np.nan_to_num(values, nan=0.5), least, 1 - least))
    return odds
