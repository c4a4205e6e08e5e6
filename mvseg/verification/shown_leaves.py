"""Which leaf does each given mask show? Asked of surfaces, as `choose.py` asks it of what a detector found.

That a given mask shows a leaf is certain. So there is one question, of every mask and every candidate: does this mask
show that surface (q)? Each mask goes where the answer is the surest, if it is likelier than where it was matched to.
Candidates are the matcher's instances, and those that it finds among the masks that do not show their own
(`match_again.py`): these explain their few masks easily, since they were fitted to nothing else, and have a price. Two
masks of one photo may show one leaf in pieces, unless they share pixels. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import DIGITS, LEAST_VIEWS
from mvseg.verification.evidence import Bools, Drawn, Evidence, Floats, Ints, draw_views, see
from mvseg.verification.leaf_scores import Candidates, log_odds
from mvseg.verification.match_again import match_again


@dataclass(frozen=True)
class GivenScores:
    """Log odds are sums of these times features; `python benchmarks/checked_ids.py --fit` fits them.

    Attributes:
        shows: of a mask, to show a candidate with a credible surface: see `shows_features`.
        matched: of one that was matched to a candidate without: times 1, and the log odds of the match score.
        price: log odds that masks must gain in all by a leaf that the first matching does not know.
    """

    shows: tuple[float, ...]
    matched: tuple[float, ...]
    price: float


GIVEN = GivenScores(shows=(1.503, 0.481, -1.538, 0.7, -0.137, 0.899), matched=(1.256, 1.057), price=6.2)


@dataclass(frozen=True, eq=False)
class Assigned:
    """What each of D given masks shows.

    Attributes:
        leaf: (D,) int64, the candidate; -1 for none.
        odds: (D,) log odds that it shows that one; 0 for none.
    """

    leaf: Ints
    odds: Floats


@dataclass(frozen=True, eq=False)
class Question:
    """Which of K candidates does each of D given masks show?

    Attributes:
        candidates: first the instances of the first matching; `certain` are the masks that stay what they are.
        leaf: (D,) int64, the candidate that each mask was matched to first, -1 for none.
        is_known: (K,) bool, the candidates of the first matching: these hide what lies behind them.
        drawn: V views of masks and surfaces.
        classes: (D,) int64; masks of one instance have one.
    """

    candidates: Candidates
    leaf: Ints
    is_known: Bools
    drawn: Sequence[Drawn]
    classes: Ints

    @staticmethod
    def of(masks: Masks, surfaces: Mapping[int, LeafSurface], cameras: Cameras, *, is_held: Bools) -> Question:
        """About D masks on the CPU that are matched; the candidates are their instances, by ascending id."""
        ids, scores = masks.instance_ids.numpy(), masks.match_scores.double().numpy()
        names = np.unique(ids[ids > 0])
        is_member = ids[:, None] == names
        fitted = [surfaces.get(name) for name in names.tolist()]
        shapes = tuple(each if each is not None and each.exists else None for each in fitted)
        candidates = Candidates(
            surfaces=shapes,
            matched=np.where(is_member, scores[:, None], np.nan),
            certain=is_member & is_held[:, None],
        )
        return Question(
            candidates=candidates,
            leaf=np.where(ids > 0, np.searchsorted(names, ids), -1),
            is_known=np.ones(len(names), bool),
            drawn=draw_views(masks.regions, shapes, cameras),
            classes=masks.classes.numpy(),
        )

    def with_more(
        self, masks: Masks, cameras: Cameras, *, config: MatchConfig, fitted: GivenScores = GIVEN
    ) -> Question:
        """The same with what the matcher finds once more, see `match_again`."""
        own = _own(show_odds(self, fitted), self.leaf)
        more = match_again(masks, self.candidates, self.leaf, odds=own, cameras=cameras, config=config)
        num_more = len(more) - len(self.candidates)
        return replace(
            self,
            candidates=more,
            is_known=np.append(self.is_known, np.zeros(num_more, bool)),
            drawn=draw_views(masks.regions, more.surfaces, cameras) if num_more else self.drawn,
        )


def show_odds(question: Question, fitted: GivenScores = GIVEN) -> Floats:
    """(D, K) log odds that each mask shows each candidate; inf where that is held, -inf where it cannot.

    It cannot show one of another class, nor one that it shares no pixel with and was not matched to; of those without a
    credible surface, none that it was not matched to.
    """
    candidates, classes, num_masks = question.candidates, question.classes, len(question.leaf)
    if not len(candidates):
        return np.zeros((num_masks, 0))
    evidence = see(question.drawn, num_masks, question.is_known & candidates.is_credible)
    by_surface = shows_features(candidates, evidence) @ np.array(fitted.shows)
    by_score = fitted.matched[0] + fitted.matched[1] * log_odds(candidates.matched)
    odds: Floats = np.where(candidates.is_credible, by_surface, by_score).round(DIGITS)
    is_member = ~np.isnan(candidates.matched)
    touches = candidates.is_credible & (evidence.claimed > 0)
    odds[~(is_member | touches) | (classes[:, None] != classes[is_member.argmax(0)])] = -np.inf
    odds[candidates.certain.any(1)] = -np.inf
    odds[candidates.certain] = np.inf
    return odds


def shows_features(candidates: Candidates, evidence: Evidence) -> Floats:
    """(D, K, 6): 1; the log odds of the match score, 0 where a mask was matched to another candidate; whether it was;
    and the log odds of `Evidence.claimed`, `visible` and `inside`."""
    is_member = ~np.isnan(candidates.matched)
    columns = np.ones_like(evidence.claimed), log_odds(candidates.matched) * is_member, ~is_member
    return np.stack((*columns, *(log_odds(each) for each in (evidence.claimed, evidence.visible, evidence.inside))), 2)


def _own(odds: Floats, leaf: Ints) -> Floats:
    """(D,) of the candidate that each mask was matched to; even ones for none."""
    return np.where(leaf >= 0, odds[np.arange(len(leaf)), leaf], 0.0) if odds.shape[1] else np.zeros(len(leaf))


def assign(question: Question, odds: Floats, is_open: Bools) -> Assigned:
    """Each mask shows the candidate of the largest log odds, but none for which they are negative, nor one that another
    mask of the view was matched to, which shares pixels with it and fits at least as well; otherwise it stays.

    Args:
        question: of D masks and K candidates.
        odds: (D, K) see `show_odds`.
        is_open: (K,) the candidates that masks may go to.
    """
    leaf, own = question.leaf, _own(odds, question.leaf)
    if not odds.shape[1]:
        return Assigned(leaf, own)
    every, elsewhere = np.arange(len(leaf)), np.where(is_open & (odds >= 0), odds, -np.inf)
    for view in question.drawn:
        shares = view.is_shared & ~np.eye(len(view.rows), dtype=bool)
        for mask, other in zip(*(view.rows[place] for place in np.nonzero(shares)), strict=True):
            if leaf[other] >= 0 and own[other] >= odds[mask, leaf[other]]:
                elsewhere[mask, leaf[other]] = -np.inf
    best = elsewhere.argmax(1)
    moves = elsewhere[every, best] > own
    return Assigned(np.where(moves, best, leaf), np.where(moves, elsewhere[every, best], own))


def settle(question: Question, fitted: GivenScores = GIVEN) -> Assigned:
    """The assignment to the leaves of the first matching, and to others that are worth their price, the one that gains
    most first."""
    odds, is_open = show_odds(question, fitted), question.is_known.copy()
    is_leaf = np.eye(len(is_open), dtype=bool)
    found = assign(question, odds, is_open)
    while True:
        trials = [(leaf, assign(question, odds, is_open | is_leaf[leaf])) for leaf in np.flatnonzero(~is_open).tolist()]
        gains = [gained(question, found, tried, leaf) for leaf, tried in trials]
        if max(gains, default=0.0) <= fitted.price:
            return found
        leaf, found = trials[int(np.argmax(gains))]
        is_open[leaf] = True


def gained(question: Question, before: Assigned, after: Assigned, leaf: int) -> float:
    """Log odds that the masks gain in all by a leaf; 0 if fewer than `LEAST_VIEWS` show it."""
    is_other, rows = before.leaf != after.leaf, np.flatnonzero(after.leaf == leaf)
    if sum(bool(np.isin(view.rows, rows).any()) for view in question.drawn) < LEAST_VIEWS:
        return 0.0
    return float(np.round((after.odds[is_other] - before.odds[is_other]).sum(), DIGITS))
