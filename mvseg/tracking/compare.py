"""How alike the leaves of all dates are, under the poses that go together best, and under the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from mvseg.arrays import Floats
from mvseg.tracking.align import Poses, guess_chance, list_poses, pose_distances, refine_alignment
from mvseg.tracking.config import Pots
from mvseg.tracking.fitted_costs import LINKS, bent_costs, fitted_costs
from mvseg.tracking.leaves import DateLeaves, Pair
from mvseg.tracking.numbers import ALIGN, LINKING
from mvseg.tracking.place_dates import place_dates, step_between

Observation = tuple[int, int]  # index of the date, row of its `DateLeaves`
Asked = Collection[tuple[Observation, Observation]]  # by the user, the earlier one first


@dataclass(frozen=True, eq=False)
class Comparison:
    """How the T dates of a plant are aligned, and how alike their leaves are.

    Attributes:
        costs: {(earlier, later): (N, M) costs of their leaves being the same}.
        poses: (T, 4, 4) first_from_date, where "first" is the earliest of the dates that are aligned with it, by way of
            others.
        roots: (T,) index of that date.
        trust: (T, T) probability that two dates stand to each other as `poses` says.
        otherwise: {(earlier, later): (N, M) probability that their leaves are the same if another pose is right}: the
            mean over the other poses, weighted by their probabilities; 0 without any.
    """

    costs: Mapping[tuple[int, int], Floats]
    poses: Floats
    roots: np.ndarray
    trust: Floats
    otherwise: Mapping[tuple[int, int], Floats]


def compare_dates(
    dates: Sequence[DateLeaves],
    times: Sequence[float],
    *,
    knows_up: bool,
    pots: Pots = "auto",
    same: Asked = (),
    different: Asked = (),
) -> Comparison:
    """Compare dates at most `LINKING.most_gap` apart, once `place_dates` has placed them, before anything is linked.
    The poses take note of `same` and `different`, pairs of observations that the user links."""
    still = ALIGN.still if pots == "auto" else 0.0
    pairs = {
        (n, later): Pair.of(dates[n], dates[later], days=times[later] - times[n], knows_up=knows_up, still=still)
        for later in range(len(dates)) for n in range(max(later - LINKING.most_gap, 0), later)
    }  # fmt: skip
    for said, cost in ((same, -LINKING.user_odds), (different, LINKING.user_odds)):
        for (earlier, row), (later, column) in said:
            if (earlier, later) in pairs:
                pairs[earlier, later].link_costs[row, column] = cost
    poses_of_pairs = {} if pots == "fixed" else {place: list_poses(pair) for place, pair in pairs.items()}
    poses, roots, steady = place_dates(len(dates), poses_of_pairs)
    if pots == "fixed":  # all stand in one frame
        roots = np.zeros(len(dates), int)
    trust = np.eye(len(dates))
    costs: dict[tuple[int, int], Floats] = {}
    otherwise: dict[tuple[int, int], Floats] = {}
    for earlier, later in sorted((place for place in pairs if roots[place[0]] == roots[place[1]]), key=np.ptp):
        pair, pose = pairs[earlier, later], step_between(poses, (earlier, later))
        alignment = refine_alignment(pair, pose)
        chance = 1.0 if pots == "fixed" else guess_chance(pair, alignment)
        trust[earlier, later] = steady[earlier:later].min() * chance
        if len(alignment.pairs):
            costs[earlier, later] = bent_costs(pair.moved(alignment.pose), alignment.pairs)
            if pots != "fixed":
                otherwise[earlier, later] = _under_others(poses_of_pairs[earlier, later], pose)
    trust = np.maximum(trust, trust.T)
    for date in range(len(dates)):  # by way of others
        trust = np.maximum(trust, np.minimum(trust[:, date, None], trust[None, date]))
    return Comparison(costs=costs, poses=poses, roots=roots, trust=trust, otherwise=otherwise)


def _under_others(of_pair: Poses, pose: Floats) -> Floats:
    """(N, M) probability that leaves are the same if another pose than this (4, 4) is right; 0 without one."""
    every = np.stack([each.pose for each in of_pair.refined])
    weights = np.round(softmax(of_pair.odds), ALIGN.digits) * (pose_distances(of_pair.pair, pose, every) >= 1)
    chances = np.zeros((len(of_pair.pair.first), len(of_pair.pair.second)))
    for weight, other in zip(weights / (weights.sum() or 1.0), every, strict=True):
        if weight:
            chances += weight * link_chances(-fitted_costs(of_pair.pair.moved(other), LINKS))
    return chances


def link_chances(odds: Floats) -> Floats:
    """(N, M) probability that leaves of two dates are the same, against all others and none, from log odds (N, M)."""
    likely = np.exp(np.clip(odds, -LINKING.most_odds, LINKING.most_odds))
    return np.asarray(likely / (1 + likely.sum(0, keepdims=True) + likely.sum(1, keepdims=True) - likely))
