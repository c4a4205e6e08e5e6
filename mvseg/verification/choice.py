"""Assign masks to leaves: the one place that decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mvseg.arrays import Bools, Floats, Ints
from mvseg.masks import Masks, Origin
from mvseg.verification.candidates import EDITED, Candidates
from mvseg.verification.evidence import Drawn, see
from mvseg.verification.leaf_scores import (
    FITTED,
    LeafScores,
    Met,
    Pairs,
    best_masks,
    leaf_chances,
    log_odds,
    show_chances,
)
from mvseg.verification.mask_colors import MaskColors
from mvseg.verification.numbers import CHOICE


@dataclass(frozen=True, eq=False)
class Step:
    """One candidate as the choice met it.

    Attributes:
        candidate: its index.
        chance: P, when the leaves before it had taken their masks.
        coverage: see `Met`.
        terms: (T,) that P follows from, as in `LEAF_TERMS`.
        rows: of the masks that it may take.
    """

    candidate: int
    chance: float
    coverage: float
    terms: Floats
    rows: Ints


@dataclass(frozen=True, eq=False)
class Choice:
    """L leaves, the likeliest first.

    Attributes:
        candidates: (L,) int64, their indices.
        chances: (L,) P.
        leaf: (D,) int64, the leaf that each mask shows, from 0 on; -1 for none.
        q: (D,) its probability; 0 for none.
        steps: of all candidates, the likeliest first.
    """

    candidates: Ints
    chances: Floats
    leaf: Ints
    q: Floats
    steps: tuple[Step, ...]


@dataclass(frozen=True, eq=False)
class Rows:
    """Terms of D masks and K candidates that hold whatever surfaces and scores say.

    Attributes:
        shows: (D, K) log odds of the user: plus infinity where the mask shows the candidate, minus where it does not.
        apart: (Q, 2) int64, masks that show different leaves, as the user says: of each pair, a candidate can have the
            likelier one alone.
        held: (D,) int64, the candidate that each given mask was matched to; -1 for none.
        hold: (D,) q from which another leaf takes a mask from the one that it is held to.
    """

    shows: Floats
    apart: Ints
    held: Ints
    hold: Floats

    @staticmethod
    def none(num_masks: int, num_candidates: int) -> Rows:
        shows, apart = np.zeros((num_masks, num_candidates)), np.zeros((0, 2), np.int64)
        return Rows(shows, apart, np.full(num_masks, -1), np.zeros(num_masks))

    @property
    def certain(self) -> Bools:
        """(D, K) whether the mask shows the candidate for certain."""
        return np.isposinf(self.shows)

    @property
    def is_leaf(self) -> Bools:
        """(K,) whether the candidate is a leaf for certain."""
        return np.asarray(self.certain.any(0), bool)

    def add_to(self, q: Floats, is_made: Bools) -> Floats:
        """(D, K) q with these terms; a mask that shows one candidate for certain shows no other. Of candidates that
        edits did not make (`is_made` (K,)), certain masks change nothing yet: these leaves stay as they were."""
        certain = self.certain & is_made
        q = np.where(np.isneginf(self.shows) | certain.any(1, keepdims=True), 0.0, q)
        for one, other in self.apart:
            odds = q + certain
            q[np.where(odds[one] < odds[other], one, other), np.arange(q.shape[1])] = 0
        return np.where(certain, 1.0, q)


def choose(
    candidates: Candidates,
    table: Masks,
    *,
    drawn: Sequence[Drawn],
    rows: Rows | None = None,
    min_probability: float | None = None,
    fitted: LeafScores = FITTED,
) -> Choice:
    """Choose leaves, and their masks of the table (D masks): in rounds, as the leaves of one hide those behind them in
    the next. Given masks are as if a detector had found them, with a score of `CHOICE.given`."""
    rows = Rows.none(len(table), len(candidates)) if rows is None else rows
    is_made = rows.is_leaf & (candidates.source == EDITED)
    scores = np.where(table.origin == Origin.GIVEN, CHOICE.given, table.detection_scores.double())
    is_other_class, colors = ~same_class(candidates, table), MaskColors.of(drawn)
    hides, steps, is_leaf, q = np.zeros(len(candidates), bool), list[Step](), rows.is_leaf, rows.shows
    for _ in range(CHOICE.rounds):
        pairs = Pairs(candidates, see(drawn, len(table), hides), scores)
        q = np.round(show_chances(pairs, fitted), CHOICE.digits)
        q[is_other_class] = 0
        q = rows.add_to(q, is_made)
        steps = rank(pairs, q, rows.certain & is_made, drawn=drawn, colors=colors, fitted=fitted)
        chances = np.array([each.chance for each in steps])
        least = least_chance(chances) if min_probability is None else min_probability
        is_leaf = rows.is_leaf.copy()
        for each in steps:
            is_leaf[each.candidate] |= each.chance >= least and len(each.rows) >= CHOICE.least_views
        hides = candidates.is_credible & is_leaf
        if not hides.any():
            break
    return _give_masks(steps, is_leaf, q, rows, drawn)


def _give_masks(steps: Sequence[Step], is_leaf: Bools, q: Floats, rows: Rows, drawn: Sequence[Drawn]) -> Choice:
    """The leaves with their masks; one with too few of them is none, unless the user, or given masks, say so."""
    is_held, every = np.isin(np.arange(len(is_leaf)), rows.held), np.arange(len(q))
    columns = np.array([each.candidate for each in steps if is_leaf[each.candidate]], np.int64)
    columns = np.concatenate((columns, np.flatnonzero(is_held & ~is_leaf)))
    if not len(columns):
        return Choice(columns, np.zeros(0), np.full(len(q), -1), np.zeros(len(q)), tuple(steps))
    place = np.full(len(is_leaf) + 1, -1)
    place[columns] = np.arange(len(columns))
    own, certain = place[rows.held], rows.certain[:, columns]
    free = np.where(is_leaf, q, 0.0)[:, columns]
    stay = np.maximum(free[every, own], rows.hold)
    free = np.where(free >= rows.hold[:, None], free, 0.0)
    free[every[own >= 0], own[own >= 0]] = stay[own >= 0]
    leaf, chance = assign_masks(free, drawn)
    leaf = np.where(leaf < 0, own, leaf)  # no mask loses its id without getting another
    is_certain, stays = certain.any(1), np.asarray(certain.any(0))
    leaf, chance = np.where(is_certain, certain.argmax(1), leaf), np.where(is_certain, 1.0, chance)
    counts = np.bincount(leaf[leaf >= 0], minlength=len(columns))
    is_left = (counts >= CHOICE.least_views) | stays | (is_held[columns] & (counts > 0))
    place = np.append(np.where(is_left, is_left.cumsum() - 1, -1), -1)  # of no leaf, too
    chances = {each.candidate: each.chance for each in steps}
    of_leaf = np.where(stays[is_left], 1.0, [chances[index] for index in columns[is_left].tolist()])
    leaf = place[leaf]
    return Choice(columns[is_left], of_leaf, leaf, chance * (leaf >= 0), tuple(steps))


def same_class(candidates: Candidates, table: Masks) -> Bools:
    """(D, K) whether a mask has the class of the masks that were matched to a candidate."""
    classes, is_member = table.classes.numpy(), ~np.isnan(candidates.matched)
    if not len(candidates):
        return np.zeros((len(table), 0), bool)
    first = is_member.argmax(0)
    return classes[:, None] == classes[first]


def rank(
    pairs: Pairs, q: Floats, certain: Bools, *, drawn: Sequence[Drawn], colors: MaskColors | None, fitted: LeafScores
) -> list[Step]:
    """Rank candidates by P. Each one takes its masks and removes overlapping masks from the rest."""
    view, place = np.zeros(len(q), np.int64), np.zeros(len(q), np.int64)
    for number, each in enumerate(drawn):
        view[each.rows], place[each.rows] = number, np.arange(len(each.rows))
    candidates, share, sure = pairs.candidates, pairs.evidence.share, log_odds(pairs.scores)
    is_open, free, clear, steps = np.ones(len(candidates), bool), q.copy(), None, []
    rows_of_views, is_first = [each.rows for each in drawn], certain.any(0)
    while is_open.any():
        best, row = best_masks(free, rows_of_views)
        met = Met(candidates, best, row, sure, share)
        clear = met.find_clear(colors) if clear is None else clear
        chances, terms = leaf_chances(met, clear, fitted)
        chances = np.where(is_first, 1.0, chances)
        chances = np.where(is_open, np.round(chances, CHOICE.digits), -1.0)
        first = int(chances.argmax())
        own = best[:, first]
        mine = row[own >= least_chance(own), first] if own.any() else np.zeros(0, np.int64)
        mine = np.union1d(mine, np.flatnonzero(certain[:, first]))
        steps.append(Step(first, float(chances[first]), float(met.coverage[first]), terms[:, first], mine))
        is_open[first] = False
        for taken in mine.tolist():
            there = drawn[view[taken]]
            free[there.rows[there.is_shared[place[taken]]]] = 0
    return steps


def least_chance(chances: Floats) -> float:
    """Lowest chance (N,) to accept, for the largest expected F1: with n accepted, 2 sum(accepted) / (n + sum(all)).
    Nothing is tuned here, and it is never above one half."""
    order = np.sort(chances)[::-1]
    if not len(order) or order[0] <= 0:
        return 1.0
    gain = np.round(order.cumsum() / (np.arange(1, len(order) + 1) + order.sum()), CHOICE.digits)
    return float(order[gain.argmax()])


def assign_masks(q: Floats, drawn: Sequence[Drawn]) -> tuple[Ints, Floats]:
    """(D,) the leaf that each mask shows, -1 = none, and its chance: in every view the assignment of masks to the L
    leaves of `q` (D, L) with the largest sum of chances, each used once. Of two masks in it that show the same, the
    likelier one stays, and the other leaf takes its next best."""
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
