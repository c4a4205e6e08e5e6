"""Poses of all dates of a plant: of the poses that pairs of dates suggest, those that go together best.

Two dates that look alike in more than one way are settled by the others. From the chain of the likeliest alignments on,
one date after the other takes, of the poses that its pairs with the others suggest, that under which all of these pairs
are likeliest, until none changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.special import expit

from mvseg.arrays import Floats
from mvseg.tracking.align import Poses, align_at, guess_chance, pose_distances, pose_odds
from mvseg.tracking.numbers import ALIGN

PosesOfPairs = Mapping[tuple[int, int], Poses]
Steps = Mapping[tuple[int, int], Floats]  # {(earlier, later): (4, 4) later_from_earlier}
Likeliness = Callable[[Floats, tuple[int, int]], float]  # of the poses (T, 4, 4) of all dates, and of two of these


def place_dates(num_dates: int, poses_of_pairs: PosesOfPairs) -> tuple[Floats, np.ndarray, Floats]:
    """The poses of T dates, from `poses_of_pairs` {(earlier, later): the poses of two dates that were looked at}.

    Returns:
        (T, 4, 4) first_from_date, where "first" is the earliest date that is compared with it, by way of others; (T,)
        the index of that date; and (T - 1,) the probability of each turn to the next date, see `weigh_turns`.
    """
    steps = {pair: poses.best.pose for pair, poses in poses_of_pairs.items()}
    chances = {pair: guess_chance(poses.pair, poses.best) for pair, poses in poses_of_pairs.items()}
    chained, roots = chain_dates(num_dates, steps, chances)
    likeliness = _remembered(poses_of_pairs)
    poses = _search(chained, steps, likeliness)
    poses = np.linalg.inv(poses[roots]) @ poses
    return poses, roots, weigh_turns(poses, poses_of_pairs, likeliness)


def weigh_turns(poses: Floats, poses_of_pairs: PosesOfPairs, likeliness: Likeliness) -> Floats:
    """(T - 1,) probability that the plant stands on all later dates as the poses (T, 4, 4) say, against the likeliest
    other turn between a date and the next: of a plant that looks the same from two sides, one half."""
    chances = np.ones(len(poses) - 1)
    for later in range(1, len(poses)):
        across = [pair for pair in poses_of_pairs if pair[0] < later <= pair[1]]
        step, rivals = poses_of_pairs.get((later - 1, later)), []
        if step is None or not step.pair.fewer:
            continue
        now = np.linalg.inv(poses[later]) @ poses[later - 1]
        every = np.stack([each.pose for each in step.refined])
        for other in every[pose_distances(step.pair, now, every) >= 1]:
            moved = poses.copy()
            moved[later:] = poses[later - 1] @ np.linalg.inv(other) @ np.linalg.inv(poses[later]) @ poses[later:]
            rivals.append(sum(likeliness(moved, pair) for pair in across))
        if rivals:
            ours = sum(likeliness(poses, pair) for pair in across)
            chances[later - 1] = expit(np.round(ours - max(rivals), ALIGN.digits))
    return chances


def chain_dates(num_dates: int, steps: Steps, chances: Mapping[tuple[int, int], float]) -> tuple[Floats, np.ndarray]:
    """Poses and roots, see `place_dates`, by way of the likeliest steps."""
    weights, poses, roots = np.zeros((num_dates, num_dates)), np.zeros((num_dates, 4, 4)), np.full(num_dates, -1)
    for pair, chance in chances.items():
        weights[pair] = -1 - round(chance, ALIGN.digits)  # any falling order will do; 0 would be no way
    tree = minimum_spanning_tree(weights)
    for root in range(num_dates):
        if roots[root] < 0:
            order, before = breadth_first_order(tree, root, directed=False)
            poses[root], roots[order] = np.eye(4), root
            for date in order[1:].tolist():
                earlier, later = sorted((date, int(before[date])))
                step = steps[earlier, later]
                poses[date] = poses[before[date]] @ (step if date == earlier else np.linalg.inv(step))
    return poses, roots


def _search(poses: Floats, steps: Steps, likeliness: Likeliness) -> Floats:
    """Move dates, each alone or with all later ones, to stand as a step to another says, if all then agree better."""
    for _ in range(ALIGN.date_rounds):
        before = poses
        for date in range(len(poses)):
            for moving in (slice(date, date + 1), slice(date, None)):
                poses = _move(poses, moving, steps, likeliness)
        if poses is before:
            break
    return poses


def _move(poses: Floats, moving: slice, steps: Steps, likeliness: Likeliness) -> Floats:
    is_moving = np.zeros(len(poses), bool)
    is_moving[moving] = True
    best, most = poses, 0.0
    apart = [pair for pair in steps if is_moving[pair[0]] != is_moving[pair[1]]]
    now = sum(likeliness(poses, pair) for pair in apart)
    for earlier, later in apart:
        step = poses[later] @ steps[earlier, later] @ np.linalg.inv(poses[earlier])
        moved = poses.copy()
        moved[moving] = (step if is_moving[earlier] else np.linalg.inv(step)) @ moved[moving]
        gain = round(sum(likeliness(moved, pair) for pair in apart) - now, ALIGN.digits)
        if gain > most:
            best, most = moved, gain
    return best


def _remembered(poses_of_pairs: PosesOfPairs) -> Likeliness:
    """Log odds of the relative pose of two dates; computed once for the same step between the same dates."""

    @cache
    def of_step(pair: tuple[int, int], step: bytes) -> float:
        of_pair = poses_of_pairs[pair].pair
        return pose_odds(of_pair, align_at(of_pair, np.frombuffer(step).reshape(4, 4)))

    def likeliness(poses: Floats, pair: tuple[int, int]) -> float:
        return of_step(pair, step_between(poses, pair).tobytes())

    return likeliness


def step_between(poses: Floats, pair: tuple[int, int]) -> Floats:
    """(4, 4) later_from_earlier; by way of whichever dates its poses (T, 4, 4) were found, it has the same digits."""
    return np.round(np.linalg.inv(poses[pair[1]]) @ poses[pair[0]], ALIGN.places)
