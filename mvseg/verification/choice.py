"""The likeliest leaf first: each takes its masks, and the others are judged by what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from mvseg.masks import Masks
from mvseg.verification.evidence import Bools, Drawn, Floats, Ints, see
from mvseg.verification.leaf_scores import (
    FITTED,
    Candidates,
    LeafScores,
    best_masks,
    leaf_chances,
    leaf_features,
    log_odds,
    show_chances,
)
from mvseg.verification.numbers import CHOICE


@dataclass(frozen=True, eq=False)
class Step:
    """One candidate as the choice met it.

    Attributes:
        candidate: its index.
        chance: P, when the leaves before it had taken their masks.
        features: (6,) that P follows from.
        rows: of the masks that it may take.
    """

    candidate: int
    chance: float
    features: Floats
    rows: Ints

    @property
    def shown_share(self) -> float:
        """Share of its expected area that its masks show, see `leaf_features`."""
        return float(self.features[1])


@dataclass(frozen=True, eq=False)
class Choice:
    """L leaves, the likeliest first.

    Attributes:
        candidates: (L,) int64, their indices.
        chances: (L,) P.
        leaf: (D,) int64, the leaf that each mask shows, from 0 on; -1 for none.
        q: (D,) how likely it does; 0 for none.
        steps: of all candidates, the likeliest first.
    """

    candidates: Ints
    chances: Floats
    leaf: Ints
    q: Floats
    steps: tuple[Step, ...]


@dataclass(frozen=True, eq=False)
class Statements:
    """Edits of the user about D masks.

    Attributes:
        is_held: (D,) bool, whether an edit is about the mask.
        is_sure: (D,) bool, whether an edit says that it shows a leaf.
        leaf: (D,) int64, its leaf before the edits, if that leaf stays as it was; -1 elsewhere.
    """

    is_held: Bools
    is_sure: Bools
    leaf: Ints

    @staticmethod
    def nothing(num_masks: int) -> Statements:
        """Statements about no mask."""
        return Statements(np.zeros(num_masks, bool), np.zeros(num_masks, bool), np.full(num_masks, -1))

    @staticmethod
    def of(num_masks: int, rows: Ints, *, is_held: Tensor, is_sure: Tensor, leaf: Tensor) -> Statements:
        """Statements about some rows of a table."""
        said = Statements.nothing(num_masks)
        said.is_held[rows], said.is_sure[rows], said.leaf[rows] = is_held, is_sure, leaf
        return said

    @property
    def is_of_others(self) -> Bools:
        """(D,) whether an edit says that the mask shows none of the leaves that edits changed."""
        return self.is_held & (~self.is_sure | (self.leaf > 0))

    def unchanged_candidates(self, q: Floats, is_taken: Bools) -> Ints:
        """Candidate of each mask (D,) of a leaf that stays and that an edit is about, -1 for the others: the one that
        all masks of the leaf show best by q (D, K). Accepted candidates (K,) first, then all."""
        of_mask = np.full(len(q), -1)
        leaves = np.unique(self.leaf[self.is_held & (self.leaf > 0)])
        if len(leaves):
            sums = np.stack([q[self.leaf == each].sum(0) for each in leaves])
            sums += len(q) * (is_taken & (sums > 0))
            for row, candidate in zip(*linear_sum_assignment(sums, maximize=True), strict=True):
                of_mask[self.is_held & (self.leaf == leaves[row])] = candidate
        return of_mask


@dataclass(frozen=True, eq=False)
class _Ranked:
    """One round of the choice.

    Attributes:
        q: (D, K) how likely each mask shows each candidate.
        steps: of all candidates, the likeliest first.
        leaves: (L,) indices of the candidates that are leaves, the likeliest first.
        stays: (L,) bool, a leaf because the user says so, whatever its chance.
        certain: (D, L) bool, a mask that shows a leaf because the user says so.
    """

    q: Floats
    steps: tuple[Step, ...]
    leaves: Ints
    stays: Bools
    certain: Bools

    @property
    def chances(self) -> Floats:
        """(L,) P of the leaves; 1 where the user says so."""
        chance = {each.candidate: each.chance for each in self.steps}
        return np.where(self.stays, 1.0, [chance[leaf] for leaf in self.leaves.tolist()])


def choose(
    candidates: Candidates,
    table: Masks,
    *,
    drawn: Sequence[Drawn],
    usable: Bools | None = None,
    statements: Statements | None = None,
    apart: Ints | None = None,
    min_probability: float | None = None,
    fitted: LeafScores = FITTED,
) -> Choice:
    """Choose leaves, and their masks of the table (D masks, `usable` (D,) ones only): in rounds, as the leaves of one
    hide those behind them in the next.

    `apart` (Q, 2): masks that show different leaves, as the user says. Of each pair, a candidate can have the likelier
    mask alone.
    """
    scores = table.detection_scores.double().numpy()
    statements = statements or Statements.nothing(len(table))
    excluded = ~same_class(candidates, table)
    if usable is not None:
        excluded |= ~usable[:, None]
    excluded |= statements.is_of_others[:, None] & candidates.is_certain
    hides, ranked = np.zeros(len(candidates), bool), None
    for _ in range(CHOICE.rounds):
        evidence = see(drawn, len(table), hides)
        q = np.round(show_chances(candidates, evidence, scores, fitted), CHOICE.digits)
        q[excluded] = 0
        for one, other in [] if apart is None else apart:
            odds = q + candidates.certain
            q[np.where(odds[one] < odds[other], one, other), np.arange(len(candidates))] = 0
        steps = rank(candidates, q, drawn=drawn, share=evidence.share, scores=scores, fitted=fitted)
        ranked = _accept(candidates, q, steps, statements, min_probability)
        hides = candidates.is_credible & np.isin(np.arange(len(candidates)), ranked.leaves)
        if not hides.any():
            break
    assert ranked is not None, "expected one round or more"
    return _give_masks(ranked, drawn)


def _accept(
    candidates: Candidates, q: Floats, steps: Sequence[Step], statements: Statements, min_probability: float | None
) -> _Ranked:
    least = least_chance(np.array([each.chance for each in steps])) if min_probability is None else min_probability
    is_taken = candidates.is_certain.copy()
    for each in steps:
        is_taken[each.candidate] |= each.chance >= least and len(each.rows) >= CHOICE.least_views
    unchanged = statements.unchanged_candidates(q, is_taken)
    stays = candidates.is_certain | np.isin(np.arange(len(candidates)), unchanged)
    leaves = np.array([each.candidate for each in steps if (is_taken | stays)[each.candidate]], np.int64)
    certain = candidates.certain[:, leaves] | (unchanged[:, None] == leaves)
    return _Ranked(q, tuple(steps), leaves, stays[leaves], certain)


def _give_masks(ranked: _Ranked, drawn: Sequence[Drawn]) -> Choice:
    """The leaves with their masks; one with too few of them is none, unless the user says so."""
    leaf, q = assign_masks(ranked.q[:, ranked.leaves], drawn)
    if len(ranked.leaves):
        is_certain = ranked.certain.any(1)
        leaf, q = np.where(is_certain, ranked.certain.argmax(1), leaf), np.where(is_certain, 1.0, q)
    counts = np.bincount(leaf[leaf >= 0], minlength=len(ranked.leaves))
    is_left = (counts >= CHOICE.least_views) | ranked.stays
    place = np.append(np.where(is_left, is_left.cumsum() - 1, -1), -1)  # of no leaf, too
    leaf = place[leaf]
    return Choice(ranked.leaves[is_left], ranked.chances[is_left], leaf, q * (leaf >= 0), ranked.steps)


def same_class(candidates: Candidates, table: Masks) -> Bools:
    """(D, K) whether a mask has the class of the masks that were matched to a candidate."""
    classes, is_member = table.classes.numpy(), ~np.isnan(candidates.matched)
    if not len(candidates):
        return np.zeros((len(table), 0), bool)
    first = is_member.argmax(0)
    return classes[:, None] == classes[first]


def rank(
    candidates: Candidates, q: Floats, *, drawn: Sequence[Drawn], share: Floats, scores: Floats, fitted: LeafScores
) -> list[Step]:
    """The candidates, the likeliest leaf first; each takes masks that those after it can no longer have, and with them
    all that show the same."""
    view, place = np.zeros(len(q), np.int64), np.zeros(len(q), np.int64)
    for number, each in enumerate(drawn):
        view[each.rows], place[each.rows] = number, np.arange(len(each.rows))
    is_open, free, clear, steps = np.ones(len(candidates), bool), q.copy(), None, []
    sure, rows_of_views = log_odds(scores), [each.rows for each in drawn]
    while is_open.any():
        best, row = best_masks(free, rows_of_views)
        features, clear = leaf_features(candidates, best, sure[row], share=share, clear=clear)
        chances = np.where(is_open, np.round(leaf_chances(candidates, features, fitted), CHOICE.digits), -1.0)
        first = int(chances.argmax())
        own = best[:, first]
        rows = row[own >= least_chance(own), first] if own.any() else np.zeros(0, np.int64)
        rows = np.union1d(rows, np.flatnonzero(candidates.certain[:, first]))
        steps.append(Step(first, float(chances[first]), features[first], rows))
        is_open[first] = False
        for taken in rows.tolist():
            there = drawn[view[taken]]
            free[there.rows[there.is_shared[place[taken]]]] = 0
    return steps


def least_chance(chances: Floats) -> float:
    """From which chance on to take things, for the largest expected F1: with n
    taken, 2 sum(chances taken) / (n + sum(all chances)). Nothing is tuned here, and it is never above one half.

    Args:
        chances: (N,) in [0, 1].
    """
    order = np.sort(chances)[::-1]
    if not len(order) or order[0] <= 0:
        return 1.0
    gain = np.round(order.cumsum() / (np.arange(1, len(order) + 1) + order.sum()), CHOICE.digits)
    return float(order[gain.argmax()])


def assign_masks(q: Floats, drawn: Sequence[Drawn]) -> tuple[Ints, Floats]:
    """(D,) the leaf that each mask shows, -1 = none, and its chance.

    In every view the assignment of masks to the L leaves of `q` (D, L) with the largest sum of chances, each used once.
    Of two masks in it that show the same, the likelier one stays, and the other leaf takes its next best.
    """
    leaf, q_of = np.full(len(q), -1), np.zeros(len(q))
    for each in drawn if q.shape[1] else ():
        free = np.where(q[each.rows] >= CHOICE.least_q, q[each.rows], 0.0)
        while True:
            masks, leaves = linear_sum_assignment(free, maximize=True)
            chances = free[masks, leaves]
            order = np.argsort(-chances, kind="stable")
            order = order[chances[order] > 0]
            masks, leaves = masks[order], leaves[order]
            conflicts = np.flatnonzero(np.triu(each.is_shared[np.ix_(masks, masks)], 1).any(0))
            if not len(conflicts):
                leaf[each.rows[masks]], q_of[each.rows[masks]] = leaves, chances[order]
                break
            free[masks[conflicts[0]]] = 0
    return leaf, q_of
