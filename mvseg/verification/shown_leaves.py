"""Which leaf does each given mask show? Asked of surfaces, as `choose.py` asks it of proposals.

That a given mask shows a leaf is certain. So there is one question, of every mask and every candidate: does this mask
show that surface (q)? Each mask goes where the answer is the surest, if that is likelier than where it was
matched to. Candidates are the matcher's instances, and those that it finds among the masks that do not show their own
(`match_again.py`): these explain their few masks easily, since they were fitted to nothing else, and have a price. Two
masks of one photo may show one leaf in pieces, unless they share pixels. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.scene import Cameras
from mvseg.verification.choice import same_class
from mvseg.verification.choose import gather_candidates
from mvseg.verification.evidence import Bools, Drawn, Evidence, Floats, Ints, draw_views, see
from mvseg.verification.leaf_scores import Candidates, log_odds
from mvseg.verification.match_again import match_again
from mvseg.verification.numbers import CHOICE


@dataclass(frozen=True)
class GivenScores:
    """`python -m benchmarks.checked_ids --fit` fits them.

    Attributes:
        shows: log odds that a mask shows a candidate are the sum of `given_features` times these, in their order.
        price: log odds that masks must gain in all by a leaf that the first matching does not know.
    """

    shows: dict[str, float]
    price: float


# Chosen, the price: any from 1.5 to 14.3 gives the dense basil the same ids; from 9.9 on, four right masks of a maize
# stay. --fit says 4.2 on real plants and simulated ones: a right mask lost is worse than one that is not won.
GIVEN = GivenScores(
    shows={"surface": 1.962, "match score": 0.359, "matched to another": -1.66, "visible": 1.214, "within": 0.764,
           "no surface": 1.007, "match score, no surface": 0.866},
    price=12.0,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MaskQuestion:
    """Question: which of K candidates does each of D given masks show?

    Attributes:
        masks: on the CPU.
        candidates: first the instances of the first matching, by id; `certain` are the masks that stay what they are.
        leaf: (D,) int64, the candidate that each mask was matched to first, -1 for none.
        is_known: (K,) bool, the candidates of the first matching: these hide what lies behind them.
        drawn: V views of masks and surfaces.
    """

    masks: Masks
    candidates: Candidates
    leaf: Ints
    is_known: Bools
    drawn: Sequence[Drawn]

    @staticmethod
    def of(
        masks: Masks,
        surfaces: Mapping[int, LeafSurface],
        cameras: Cameras,
        *,
        is_held: Bools,
        more: Sequence[Masks] = (),
        cache: SurfaceCache | None = None,
    ) -> MaskQuestion:
        """About the instances of masks with their surfaces, and those of `more`, the same masks with other ids."""
        found = [(each, torch.arange(len(masks))) for each in (masks, *more)]
        held = torch.from_numpy(is_held)
        candidates = gather_candidates(found, cameras, table=masks, is_held=held, surfaces=surfaces, cache=cache)
        ids = masks.instance_ids.numpy()
        names = np.unique(ids[ids > 0])
        return MaskQuestion(
            masks=masks,
            candidates=candidates,
            leaf=np.where(ids > 0, np.searchsorted(names, ids), -1),
            is_known=np.arange(len(candidates)) < len(names),
            drawn=draw_views(masks.regions, candidates.surfaces, cameras),
        )


def ask(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
    config: MatchConfig,
    is_held: Bools,
    fitted: GivenScores = GIVEN,
    cache: SurfaceCache | None = None,
) -> MaskQuestion:
    """Question about D matched masks on the CPU, also of the instances that the matcher finds once more."""
    first = MaskQuestion.of(masks, surfaces, cameras, is_held=is_held)
    odds = show_odds(first, fitted)[np.arange(len(masks)), first.leaf]
    more = match_again(masks, first.leaf, odds=odds, cameras=cameras, config=config)
    return MaskQuestion.of(masks, surfaces, cameras, is_held=is_held, more=more, cache=cache) if more else first


def show_odds(question: MaskQuestion, fitted: GivenScores = GIVEN) -> Floats:
    """(D, K + 1) log odds that each mask shows each candidate, and 0, of none; inf where that is held, -inf where it
    cannot.

    It cannot show one of another class, nor one that it shares no pixel with and was not matched to; of those without a
    credible surface, none that it was not matched to.
    """
    candidates, masks = question.candidates, question.masks
    evidence = see(question.drawn, len(masks), question.is_known & candidates.is_credible)
    odds = np.round(given_features(candidates, evidence) @ list(fitted.shows.values()), CHOICE.digits)
    is_near = ~np.isnan(candidates.matched) | (candidates.is_credible & (evidence.claimed > 0))
    odds[~is_near | ~same_class(candidates, masks)] = -np.inf
    is_apart = masks.is_linked.numpy() & (question.leaf < 0)  # the user only says which leaf they do not show
    odds[candidates.certain.any(1) | is_apart] = -np.inf
    odds[candidates.certain] = np.inf
    return np.column_stack((odds, np.zeros(len(masks))))


def given_features(candidates: Candidates, evidence: Evidence) -> Floats:
    """(D, K, 7). Of a credible surface, 0 for others: 1; the log odds of the match score, 0 where a mask was matched to
    another candidate; whether it was; and the log odds of `Evidence.visible` and `within`. Of a candidate without: 1,
    and the log odds of the match score.

    What hides a surface may be drawn wrong: a mask that lies within it as a whole may well show it.
    """
    has_shape, score = candidates.is_credible, log_odds(candidates.matched)
    ones, shares = np.ones_like(score), (log_odds(evidence.visible), log_odds(evidence.within))
    by_surface = (each * has_shape for each in (ones, score, np.isnan(candidates.matched), *shares))
    return np.stack((*by_surface, ones * ~has_shape, score * ~has_shape), 2)


def assign(question: MaskQuestion, odds: Floats, is_open: Bools) -> tuple[Ints, Floats]:
    """(D,) the candidate that each mask shows, -1 for none, and (D,) the log odds that it does.

    That of the largest log odds, but none for which they are negative, nor one that another mask of the view was
    matched to, which shares pixels with it and fits at least as well; otherwise it stays.

    Args:
        question: of D masks and K candidates.
        odds: (D, K + 1) see `show_odds`.
        is_open: (K,) the candidates that masks may go to.
    """
    every, leaf = np.arange(len(question.leaf)), question.leaf
    own, elsewhere = odds[every, leaf], np.where(np.append(is_open, False) & (odds >= 0), odds, -np.inf)
    for view in question.drawn:
        shares = view.is_shared & ~np.eye(len(view.rows), dtype=bool)
        for mask, other in zip(*(view.rows[place] for place in np.nonzero(shares)), strict=True):
            if leaf[other] >= 0 and own[other] >= odds[mask, leaf[other]]:
                elsewhere[mask, leaf[other]] = -np.inf
    best = elsewhere.argmax(1)
    moves = elsewhere[every, best] > own
    return np.where(moves, best, leaf), np.where(moves, elsewhere[every, best], own)


def settle_masks(question: MaskQuestion, fitted: GivenScores = GIVEN) -> tuple[Ints, Floats]:
    """The assignment to the leaves of the first matching, and to others that are worth their price, the one that gains
    most first."""
    odds, is_open = show_odds(question, fitted), question.is_known.copy()
    is_leaf = np.eye(len(is_open), dtype=bool)
    chosen = assign(question, odds, is_open)
    while True:
        later = np.flatnonzero(~is_open & question.candidates.is_credible).tolist()
        trials = [(leaf, assign(question, odds, is_open | is_leaf[leaf])) for leaf in later]
        gains = [gained(question, chosen, tried, leaf) for leaf, tried in trials]
        if max(gains, default=0.0) <= fitted.price:
            return chosen
        leaf, chosen = trials[int(np.argmax(gains))]
        is_open[leaf] = True


def gained(question: MaskQuestion, before: tuple[Ints, Floats], after: tuple[Ints, Floats], leaf: int) -> float:
    """Log odds that the masks gain in all by a leaf; 0 if fewer than `CHOICE.least_views` show it."""
    is_other = before[0] != after[0]
    if len(np.unique(question.masks.view_index.numpy()[after[0] == leaf])) < CHOICE.least_views:
        return 0.0
    return float(np.round((after[1][is_other] - before[1][is_other]).sum(), CHOICE.digits))
