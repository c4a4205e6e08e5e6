"""How alike the leaves of all dates are, under the poses that go together best, and under the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvseg.tracking.align import (
    Alignment,
    Habit,
    Poses,
    guess_chance,
    judge,
    link_gain,
    list_poses,
    pose_distances,
    refine,
)
from mvseg.tracking.config import Pots
from mvseg.tracking.costs import ACROSS, Leaves, Pair, cloud_costs, pair_costs
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import LINKS, fitted_costs
from mvseg.tracking.motions import Motion, find_motion
from mvseg.tracking.place_dates import place_dates

MOST_GAP = 3  # dates from one sight to another that it is compared with, at most: two dates may hide a leaf
UNLINKED = 2.0  # a pair may cost that much in a track before two tracks are cheaper than one; / dates in between
CLOUD_COUNTS = 0.3  # of the points of two surfaces, whose midribs say most already, and the other way round
MOST_HELP = 8.0
IN_PART = 0.3  # change of log length from which one of two surfaces may show a part of the leaf only
ENOUGH = 6  # pairs, from which the others say how the plant bent where a leaf is; with 7 all is the same, 5 are too few
LIKE_RIGID = 0.3  # weight of "the plant moved as a whole", in leaves
RARE = 1e-4  # poses that are less likely say nothing of a link (a technical limit)
MOST_ODDS = 40.0  # of log odds, whose exponentials are numbers then (a technical limit)


@dataclass(frozen=True, eq=False)
class Comparison:
    """How the T dates of a plant are aligned, and how alike their leaves are.

    Attributes:
        costs: {(earlier, later): (N, M) costs of their leaves being the same}.
        poses: (T, 4, 4) first_from_date, where "first" is the earliest of the dates that are aligned with it, by way of
            others.
        roots: (T,) index of that date.
        trust: (T, T) probability that two dates stand to each other as `poses` says.
        otherwise: {(earlier, later): (N, M) probability that their leaves are the same, over the other poses that were
            looked at}, each as likely as it is among them; not there where there are none.
        motions: {(earlier, later): of leaves that moved otherwise than the rest}, where there are any.
    """

    costs: Mapping[tuple[int, int], Floats]
    poses: Floats
    roots: np.ndarray
    trust: Floats
    otherwise: Mapping[tuple[int, int], Floats]
    motions: Mapping[tuple[int, int], Motion]


def compare_dates(
    dates: Sequence[Leaves], times: Sequence[float], *, knows_up: bool, pots: Pots = "auto"
) -> Comparison:
    """Dates at most MOST_GAP apart are compared.

    `place_dates` says how they stand to each other, before anything is linked.
    """
    pairs = {
        (n, later): Pair.of(dates[n], dates[later], days=times[later] - times[n], knows_up=knows_up)
        for later in range(len(dates)) for n in range(max(later - MOST_GAP, 0), later)
    }  # fmt: skip
    looked = {place: list_poses(pair) for place, pair in pairs.items()}
    habit = Habit.of([judge(poses, Habit.of([], pots)) for poses in looked.values()], pots)
    poses, roots, steady = place_dates(len(dates), looked, habit)
    trust = np.eye(len(dates))
    costs: dict[tuple[int, int], Floats] = {}
    otherwise: dict[tuple[int, int], Floats] = {}
    motions: dict[tuple[int, int], Motion] = {}
    for earlier, later in sorted((place for place in pairs if roots[place[0]] == roots[place[1]]), key=np.ptp):
        pair, pose = pairs[earlier, later], np.linalg.inv(poses[later]) @ poses[earlier]
        alignment = refine(pair, pose) if pair.fewer else Alignment(pose, np.zeros((0, 2), int))
        trust[earlier, later] = steady[earlier:later].min() * looked[earlier, later].chance(alignment.pose, habit)
        if not len(alignment.pairs):
            continue
        costs[earlier, later] = _link_costs(pair, alignment)
        left = _under_others(looked[earlier, later], pose, habit)
        if left is not None:
            otherwise[earlier, later] = left
        is_step = roots[later] not in roots[earlier + 1 : later]
        if is_step or any(earlier <= a and b <= later for a, b in motions):  # a leaf that grew is no motion over weeks
            motion = find_motion(pair, alignment.pose)
            if motion is not None:
                both = link_gain(pair, alignment.pose) + motion.gain
                if motion.is_sure:  # the other turn is that of a second plant
                    trust[earlier, later] = max(trust[earlier, later], guess_chance(both, pair.fewer))
                motions[earlier, later] = motion
                costs[earlier, later] = _parted_costs(pair, motion, costs[earlier, later])
    trust = np.maximum(trust, trust.T)
    for date in range(len(dates)):  # by way of others
        trust = np.maximum(trust, np.minimum(trust[:, date, None], trust[None, date]))
    return Comparison(
        costs=costs, poses=poses, roots=roots, trust=trust, otherwise=otherwise, motions=motions
    )  # fmt: skip


def _under_others(looked: Poses, pose: Floats, habit: Habit) -> Floats | None:
    """(N, M) probability that leaves of two dates are the same if not this pose (4, 4) but another one is right."""
    every = np.stack([each.pose for each in looked.refined])
    weights = looked.weights(habit) * (pose_distances(looked.pair, pose, every) >= 1)
    total = float(weights.sum())
    if total < RARE:
        return None
    chances = np.zeros((len(looked.pair.first), len(looked.pair.second)))
    for weight, other in zip(weights / total, every, strict=True):
        if weight >= RARE:
            odds = np.exp(np.clip(-fitted_costs(looked.pair.moved(other), LINKS), -MOST_ODDS, MOST_ODDS))
            rivals = odds.sum(0, keepdims=True) + odds.sum(1, keepdims=True) - odds
            chances += weight * odds / (1 + rivals)
    return chances


def _link_costs(pair: Pair, alignment: Alignment) -> Floats:
    """(N, M) costs of leaves of two aligned dates being the same. Where few leaves are paired, they do not tell how the
    plant bent."""
    if len(alignment.pairs) < ENOUGH:
        return fitted_costs(pair.moved(alignment.pose), LINKS)
    return _bent_costs(pair, alignment)


def _bent_costs(pair: Pair, alignment: Alignment) -> Floats:
    """Costs after the plant was let bend and stretch: each leaf moves as the other pairs say, not as its own does."""
    first, second, scale, pairs = pair.first, pair.second, pair.scale, alignment.pairs
    moved = first.moved(alignment.pose)
    one, other = moved.bases[pairs[:, 0]], second.bases[pairs[:, 1]]
    middle = one.mean(0)
    terms = np.column_stack([np.ones(len(one)), (one - middle) / scale])
    away = other - one
    weight = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / (3 * ACROSS * scale)))
    ridge = LIKE_RIGID * np.diag([1.0, 1.0, 1.0, 1.0])
    inverse = np.linalg.inv(terms.T @ (terms * weight[:, None]) + ridge)
    factors = inverse @ (terms * weight[:, None]).T @ away
    everywhere = np.column_stack([np.ones(len(moved)), (moved.bases - middle) / scale]) @ factors
    leverage = np.einsum("pi,ij,pj->p", terms, inverse, terms) * weight
    fitted = terms @ factors
    everywhere[pairs[:, 0]] = away - (away - fitted) / np.maximum(1 - leverage, 0.1)[:, None]  # without its own pair
    bent = moved.shifted(everywhere)
    rest = np.linalg.norm((other - bent.bases[pairs[:, 0]])[:, :2], axis=1) / (1.18 * ACROSS * scale)
    spread = float(np.clip(np.median(rest), 0.7, 2.0))
    in_place = replace(pair, first=bent)
    costs, clouds = pair_costs(in_place, spread=spread), cloud_costs(in_place, spread=spread)
    both = first.is_surface[:, None] & second.is_surface[None]
    by_midrib = costs + CLOUD_COUNTS * np.minimum(clouds, 0.0)
    by_cloud = clouds + CLOUD_COUNTS * np.clip(costs, -MOST_HELP, MOST_HELP)
    in_part = np.abs(np.log(second.lengths[None] / first.lengths[:, None])) > IN_PART
    return np.where(both, np.where(in_part, np.minimum(by_midrib, by_cloud), by_midrib), by_cloud)


def _parted_costs(pair: Pair, motion: Motion, costs: Floats) -> Floats:
    """The costs where the leaves of a second motion are linked with each other only, and only if it is sure."""
    rows, columns = motion.pairs.T
    parted = costs.copy()
    parted[rows], parted[:, columns] = np.maximum(parted[rows], UNLINKED), np.maximum(parted[:, columns], UNLINKED)
    if motion.is_sure:
        part = pair.take(rows, columns)
        alignment = refine(part, motion.pose)
        if len(alignment.pairs):
            parted[np.ix_(rows, columns)] = _link_costs(part, alignment)
    return parted
