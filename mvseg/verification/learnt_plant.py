"""One plant is not like all others: what a person says of some of its leaves shifts the score of the rest.

The scores of `leaf_scores.py` are fitted to many plants. On another one, the log odds that a candidate is a leaf are
off by about one number: over nine plants of eight kinds, the shift of greatest likelihood has a standard deviation of
`LEAF_SHIFT`. With that as a Gaussian prior, the labels of a person give the most probable shift: a few labels move
little, ten of one kind move a doubtful leaf from one half to one third. The score of masks stays: a person rejects the
wrong ones and is silent on the right ones, and what was learnt from that did harm (docs/correcting.md). Not in the
paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import fsum

import numpy as np
import torch
from scipy.optimize import brentq, linear_sum_assignment
from scipy.special import expit

from mvseg.masks import Masks
from mvseg.scene import Cameras
from mvseg.verification.choose import Leaves
from mvseg.verification.evidence import FITS, Bools, Floats, Ints, draw_views
from mvseg.verification.leaf_scores import FITTED, LeafScores, log_odds

LEAF_SHIFT = 0.45  # standard deviation of the prior, log odds
DIGITS = 6  # of a shift that count

Rejection = tuple[int, int, int, bool]  # view, x, y (pixels, undistorted), whether in all photos


@dataclass(frozen=True, eq=False)
class Labels:
    """What a person's edits say of N candidates, each once.

    Attributes:
        chances: (N,) P, as `FITTED` gives it without a person.
        is_leaf: (N,) bool, what the person says.
    """

    chances: Floats
    is_leaf: Bools


def learn_plant(labels: Labels, fitted: LeafScores = FITTED) -> LeafScores:
    """The scores of this plant: `fitted`, where P of candidates has other first numbers. Without labels, exactly
    `fitted`."""
    shift = learn_shift(labels)
    return replace(
        fitted,
        leaf=(fitted.leaf[0] + shift, *fitted.leaf[1:]),
        found=(fitted.found[0] + shift, *fitted.found[1:]),
    )


def learn_shift(labels: Labels) -> float:
    """The most probable shift of log odds, to `DIGITS`; 0.0 without labels."""
    if not len(labels.chances):
        return 0.0
    odds, right, variance = log_odds(labels.chances), labels.is_leaf.astype(np.float64), LEAF_SHIFT**2

    def slope(shift: float) -> float:  # of the log posterior; it falls, and N labels pull by N at most
        return fsum((right - expit(odds + shift)).tolist()) - shift / variance

    most = len(odds) * variance
    return round(float(brentq(slope, -most, most, xtol=1e-12)), DIGITS)


def label_leaves(
    alone: Leaves, matched: Masks, *, is_held: Bools, rejected: Sequence[Rejection], cameras: Cameras
) -> Labels:
    """What a person's edits say of the candidates that the views choose, or leave out, without them.

    A candidate is a leaf if a leaf of the person's is that one: if his masks, those that he made, confirmed or linked,
    and the others of their instances, agree with more of its masks than of others' (one candidate each). It is none if
    he rejects it in all photos. What two edits say both ways is left out.

    Args:
        alone: the choice without a person.
        matched: D masks on the CPU, after the edits, matched.
        is_held: (D,) bool, those that the person made, confirmed or linked.
        rejected: where he says that no leaf is.
        cameras: V cameras.
    """
    chances = np.array([*alone.probabilities.values(), *(each.chance for each in alone.left)])
    groups = [alone.masks.select(alone.masks.instance_ids == leaf) for leaf in alone.probabilities]
    groups += [each.masks for each in alone.left]
    if not groups:
        return Labels(np.zeros(0), np.zeros(0, bool))
    table, candidate = Masks.concatenate(groups), np.repeat(np.arange(len(groups)), [len(each) for each in groups])
    ids = matched.instance_ids.numpy()
    is_own = np.isin(ids, ids[is_held]) & (ids > 0)
    row, other = _agreeing(table, matched.select(torch.from_numpy(is_own)), cameras)
    persons, instance = np.unique(ids[is_own], return_inverse=True)
    votes = np.zeros((len(persons), len(groups)))
    np.add.at(votes, (instance[other], candidate[row]), 1)
    first, second = linear_sum_assignment(votes, maximize=True)
    is_leaf, is_none = np.zeros((2, len(groups)), bool)
    is_leaf[second[votes[first, second] > 0]] = True
    for *place, is_about_all in rejected:
        found = _mask_at(table, candidate < len(alone.probabilities), place)
        if found is not None and is_about_all:
            is_none[candidate[found]] = True
    is_said = is_leaf != is_none
    return Labels(chances[is_said], is_leaf[is_said])


def _agreeing(one: Masks, two: Masks, cameras: Cameras) -> tuple[Ints, Ints]:
    """The pairs of rows of two tables that show the same pixels, by `FITS`."""
    pairs = [np.zeros((0, 2), np.int64)]
    for each in draw_views(Masks.concatenate((one, two)).regions, (), cameras):
        areas, both = each.masks.sum(0), (each.masks.T @ each.masks).toarray()
        agrees = np.argwhere(both > FITS * (areas[:, None] + areas - both))
        rows = each.rows[agrees]
        pairs.append(rows[(rows[:, 0] < len(one)) & (rows[:, 1] >= len(one))])
    first, second = np.concatenate(pairs).T
    return first, second - len(one)


def _mask_at(masks: Masks, is_chosen: Bools, place: Sequence[int]) -> int | None:
    """The row of the mask that a pixel (view, x, y) lies in: of several, a chosen one, and the smallest."""
    view, column, line = place
    rows = masks.regions.at(view, column, line)
    return min(rows, key=lambda row: (not is_chosen[row], int(masks.regions.areas[row])), default=None)
