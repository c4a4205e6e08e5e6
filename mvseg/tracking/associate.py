"""Tracks over all dates at once: the sights of leaves are parted such that the costs within tracks are least.

Not only neighbouring dates count: each leaf is compared with those of the three dates before and after, and a track's
cost is the sum over all of its pairs. A leaf that looks odd on one date, or is missed, is held by the dates around it.
The least sum is hard to find (a multicut, see Keuper et al., ICCV 2015); here all tracks are cut at a date, or one date
is taken out of them, and their parts are joined anew, exactly (`linear_sum_assignment`), until that gains nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from mvseg.errors import InputError
from mvseg.tracking.align import Alignment, Habit, guess_chance, judge, link_gain, list_poses, refine
from mvseg.tracking.config import Pots
from mvseg.tracking.costs import ACROSS, Leaves, Pair, cloud_costs, pair_costs
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import LINKS, fitted_costs
from mvseg.tracking.motions import Motion, find_motion
from mvseg.tracking.place_dates import place_dates

Sight = tuple[int, int]  # index of the date, row of its `Leaves`
MOST_GAP = 3  # dates from one sight to another that it is compared with, at most: two dates may hide a leaf
UNLINKED = 2.0  # a pair may cost that much in a track before two tracks are cheaper than one; / dates in between
CLOUD_COUNTS = 0.3  # of the points of two surfaces, whose midribs say most already, and the other way round
MOST_HELP = 8.0
IN_PART = 0.3  # change of log length from which one of two surfaces may show a part of the leaf only
ASKED = 1e4  # gain of what a person says
ENOUGH = 6  # pairs, from which the others say how the plant bent where a leaf is; with 7 all is the same, 5 are too few
# Slope and offset of the log odds of a link: between those fitted on simulated series (0.25, 2.8) and those fitted on
# seedlings, too (0.35, 3.55); the calibration error of seedlings is 0.052, 0.045 and 0.045 with the three.
CALIBRATION = (0.3, 3.3)
BY_CHANCE = 0.5  # how likely a link is right where the pose is wrong: no better than even (a definition)
LIKE_RIGID = 0.3  # weight of "the plant moved as a whole", in leaves
ROUNDS = 10  # of joining anew, at most; two or three are enough


@dataclass(frozen=True, eq=False)
class Comparison:
    """How the T dates of a plant are aligned, and how alike their leaves are.

    Attributes:
        costs: {(earlier, later): (N, M) costs of their leaves being the same}.
        poses: (T, 4, 4) first_from_date, where "first" is the earliest of the dates that are aligned with it, by way of
            others.
        roots: (T,) index of that date.
        trust: (T, T) probability that two dates stand to each other as `poses` says.
        motions: {(earlier, later): of leaves that moved otherwise than the rest}, where there are any.
    """

    costs: Mapping[tuple[int, int], Floats]
    poses: Floats
    roots: np.ndarray
    trust: Floats
    motions: Mapping[tuple[int, int], Motion]


@dataclass(frozen=True)
class Link:
    """Two sights of one leaf that follow each other, and the probability that they are of one."""

    before: Sight
    after: Sight
    probability: float


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
    motions: dict[tuple[int, int], Motion] = {}
    for earlier, later in sorted((place for place in pairs if roots[place[0]] == roots[place[1]]), key=np.ptp):
        pair, pose = pairs[earlier, later], np.linalg.inv(poses[later]) @ poses[earlier]
        alignment = refine(pair, pose) if pair.fewer else Alignment(pose, np.zeros((0, 2), int))
        trust[earlier, later] = steady[earlier:later].min() * looked[earlier, later].chance(alignment.pose, habit)
        if not len(alignment.pairs):
            continue
        costs[earlier, later] = _link_costs(pair, alignment)
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
    return Comparison(costs, poses, roots, trust, motions)


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


def link_leaves(
    counts: Sequence[int],
    costs: Mapping[tuple[int, int], Floats],
    *,
    trust: Floats | None = None,
    same: Collection[tuple[Sight, Sight]] = (),
    different: Collection[tuple[Sight, Sight]] = (),
) -> list[Link]:
    """The links of the cheapest tracks, by their earlier sight.

    Args:
        counts: number of leaves with a shape on each date.
        costs, trust: see `Comparison`; None: all dates are surely aligned.
        same, different: pairs of sights that a person says are one leaf, or are not.

    Raises:
        InputError: the pairs contradict each other.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    date_of, gains = np.repeat(np.arange(len(counts)), counts), np.zeros((starts[-1], starts[-1]))
    for (a, b), of_pair in costs.items():
        gains[starts[a] : starts[a + 1], starts[b] : starts[b + 1]] = (UNLINKED - of_pair) / (b - a)
    asked = {(starts[a] + i, starts[b] + j): sign * ASKED for said, sign in ((same, 1), (different, -1))
             for (a, i), (b, j) in said}  # fmt: skip
    for place, gain in asked.items():
        gains[place] = gain
    gains += gains.T
    tracks = join_sights(gains, date_of)
    if any((tracks[one] == tracks[other]) != (gain > 0) for (one, other), gain in asked.items()):
        raise InputError("what a person says of leaves over days contradicts itself")
    links = []
    for later in range(1, len(counts)):
        chances = _probabilities(tracks, gains, later=date_of >= later)
        for after in np.flatnonzero(date_of == later):
            known = np.flatnonzero((tracks == tracks[after]) & (date_of < later))
            if len(known):
                before, chance = known[-1], chances[tracks[after]]
                is_asked = gains[known, after].max() >= ASKED
                both = [(int(date_of[n]), int(n - starts[date_of[n]])) for n in (before, after)]
                chance *= 1.0 if trust is None else BY_CHANCE + (1 - BY_CHANCE) * float(trust[both[0][0], later])
                links.append(Link(both[0], both[1], 1.0 if is_asked else chance))
    return links


def join_sights(gains: Floats, date_of: np.ndarray) -> np.ndarray:
    """(S,) the track of each sight, such that the gains within tracks are large; none has two sights of a date.

    Args:
        gains: (S, S) symmetric, of each pair in one track; 0 for pairs that were not compared.
        date_of: (S,) index of the date of each sight.
    """
    tracks, dates = np.arange(len(gains)), np.unique(date_of)
    for date in dates[1:]:
        tracks = _rejoin(tracks, gains, date_of == date, among=date_of <= date)
    for _ in range(ROUNDS):
        before = tracks[:, None] == tracks
        for date in dates:
            for apart in (date_of > date, date_of == date):
                tracks = _rejoin(tracks, gains, apart)
        if ((tracks[:, None] == tracks) == before).all():
            break
    return tracks


def _rejoin(tracks: np.ndarray, gains: Floats, apart: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
    """The tracks cut in two, what is `apart` (S,) and the rest, and their parts joined for the largest gain."""
    rest = ~apart if among is None else among & ~apart
    here, there, table = _part_gains(tracks, gains, rest, apart)
    rows, columns = linear_sum_assignment(np.maximum(table, 0.0), maximize=True)
    is_better = table[rows, columns] > 0
    names = tracks.max(initial=0) + 1 + np.arange(len(there))
    names[columns[is_better]] = here[rows[is_better]]
    joined = tracks.copy()
    joined[apart] = names[np.searchsorted(there, tracks[apart])]
    return joined


def _part_gains(
    tracks: np.ndarray, gains: Floats, one: np.ndarray, other: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Floats]:
    """The tracks among the sights `one` (S,) and `other` (S,), and the gains (A, B) of joining each two of them."""
    (here, row), (there, column) = (np.unique(tracks[part], return_inverse=True) for part in (one, other))
    return here, there, np.eye(len(here))[row].T @ gains[np.ix_(one, other)] @ np.eye(len(there))[column]


def _probabilities(tracks: np.ndarray, gains: Floats, later: np.ndarray) -> dict[int, float]:
    """{track: that its later sights are of the same leaf as those before}, against all other parts each could go with.

    With gains as log odds, p = e^g / (1 + e^g + the sum of e^g over the others); its log odds are then stretched
    (`CALIBRATION`).
    """
    here, there, table = _part_gains(tracks, gains, ~later, later)
    odds, found = np.exp(np.clip(table, -40, 40)), {}
    for track in np.intersect1d(here, there).tolist():
        row, column = np.searchsorted(here, track), np.searchsorted(there, track)
        others = odds[row].sum() + odds[:, column].sum() - 2 * odds[row, column]
        logit = CALIBRATION[0] * (np.log(odds[row, column]) - np.log1p(others)) + CALIBRATION[1]
        found[track] = float(expit(logit))
    return found
