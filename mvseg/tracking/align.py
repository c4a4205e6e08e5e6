"""The plant of one date in the frame of another: the pot may have been turned, moved, set down askew.

That the pot stands as it stood is one hypothesis among many; the others come from pairs of leaves. Each is refined on
the leaves that it pairs. Its probability follows from how well they go together, and from how often this plant's pot is
turned (`Habit`). The best one is taken, and its probability says how far to trust it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from scipy.special import expit

from mvseg.tracking.config import Pots
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import POSES, fitted_costs
from mvseg.tracking.leaves import Pair
from mvseg.tracking.numbers import ALIGN

GUESS = (-2.02, 0.99, 2.05)  # fitted: python benchmarks/fit_chances.py; offset, own and strange gain


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pose of the plant of one date on another.

    Attributes:
        pose: (4, 4) second_from_first, a rotation and a shift.
        pairs: (P, 2) leaves of the two dates (rows of `Leaves`) that go together.
        gain: how much likelier these pairs are the same leaves than strangers, a natural logarithm.
        probability: that the pose is right, see `guess_chance`.
        still: probability that the pot stands as it stood.
    """

    pose: Floats
    pairs: np.ndarray
    gain: float = 0.0
    probability: float = 1.0
    still: float = 0.5


@dataclass(frozen=True)
class Habit:
    """How often a pot stands as on the date before: stated by the user, or estimated from the dates of a plant. `still`
    is its probability, before anything is known of a pair of dates."""

    still: float = ALIGN.still

    @staticmethod
    def of(alignments: Sequence[Alignment], pots: Pots) -> Habit:
        """From alignments of a plant's dates; each counts as much as it is known."""
        if pots != "auto":
            return Habit(1.0 if pots == "fixed" else 0.0)
        known = ALIGN.prior_pairs * ALIGN.still + sum(each.still for each in alignments)
        return Habit(known / (ALIGN.prior_pairs + len(alignments)))

    @property
    def world_prior(self) -> float:
        """Log of the probability that the pot was not turned, over that of any single turn."""
        least = ALIGN.least_still
        return math.log(max(self.still, least) / max((1 - self.still) / ALIGN.turns, least))


@dataclass(frozen=True, eq=False)
class Poses:
    """H poses of one pair of dates, the first as it stood, that were looked at.

    Attributes:
        gains: (H,) their gains, less the cost of large new leaves.
        near: (H,) in [0, 1], how near they are to "as it stood".
    """

    pair: Pair
    refined: tuple[Alignment, ...]
    gains: Floats
    near: Floats

    def scores(self, habit: Habit) -> Floats:
        """(H,) gains, and what the habit of the pot says."""
        return self.gains + habit.world_prior / ALIGN.temper * self.near

    def weights(self, habit: Habit) -> Floats:
        """(H,) the poses as probabilities."""
        scores = self.scores(habit)
        weights = np.exp(ALIGN.temper * (scores - scores.max()))
        return np.asarray(weights / weights.sum())

    def chance(self, pose: Floats, habit: Habit) -> float:
        """How likely a pose (4, 4) is right."""
        if habit.still == 1:
            return 1.0
        if not self.pair.fewer:
            return habit.still
        return guess_chance(pose_gain(self.pair, pose), self.pair.fewer)


def list_poses(pair: Pair) -> Poses:
    """The poses of two dates, each in its own frame, that look best, and those suggested by leaves that the user links,
    each refined; where up is not known, of any rotation. Without leaves on one date, only "as it stood"."""
    if not pair.fewer:
        return Poses(pair, (Alignment(np.eye(4), np.zeros((0, 2), int)),), np.zeros(1), np.ones(1))
    asked = [draw_poses(pair.take(row, column)) for row, column in np.argwhere(pair.link_costs < 0)[..., None]]
    looked_at = np.concatenate([np.eye(4)[None], *asked])
    poses = np.concatenate([looked_at, draw_poses(pair)])
    rank = np.repeat([0, 1, 2], [1, len(looked_at) - 1, len(poses) - len(looked_at)])  # the first ones in any case
    refined: list[Alignment] = [_as_it_stood(pair)]
    left = np.lexsort((-alikeness(pair, poses).sum(1), rank))
    while len(left) and len(refined) < ALIGN.num_refined:
        refined.append(refine_alignment(pair, poses[left[0]]))
        left = left[pose_distances(pair, poses[left[0]], poses[left]) >= 1]
    every = np.stack([each.pose for each in refined])
    gains = np.array([each.gain - large_new(pair, each.pairs) for each in refined])
    return Poses(pair, tuple(refined), gains, near_world(pair, every))


def judge(poses: Poses, habit: Habit) -> Alignment:
    """The best of the poses, and how likely it is."""
    place = int(np.round(poses.scores(habit), ALIGN.digits).argmax()) if habit.still < 1 else 0
    best, weights = poses.refined[place], poses.weights(habit)
    still = float(weights[poses.near > np.exp(-0.5)].sum()) if poses.pair.fewer else habit.still
    return replace(best, still=still, probability=poses.chance(best.pose, habit))


def guess_chance(gain: float, leaves: int) -> float:
    """How likely a pose is right.

    Args:
        gain: see `pose_gain`; that of another plant is low. (Once all dates are placed, how likely the pose is among
            others of the two dates says nothing more.)
        leaves: number of leaves of the date with fewer, >= 1. They are neither independent, then the sum of their
            evidence would count, nor all the same, then the mean would: the sum counts over the root of their number.
    """
    offset, own, strange = GUESS
    return float(expit(offset + (own * gain / leaves - strange) * math.sqrt(leaves)))


def pose_gain(pair: Pair, pose: Floats) -> float:
    """How much likelier the pairs under a pose (4, 4) are the same leaves than strangers."""
    costs = fitted_costs(pair.moved(pose))
    return float(-costs[tuple(best_pairs(costs).T)].sum())


def _as_it_stood(pair: Pair) -> Alignment:
    costs = fitted_costs(pair)
    pairs = best_pairs(costs)
    return Alignment(np.eye(4), pairs, gain=float(-costs[pairs[:, 0], pairs[:, 1]].sum()))


def large_new(pair: Pair, pairs: np.ndarray) -> float:
    """Cost of leaves of the larger half that are in no pair, as when a plant is turned onto its own older leaves. 0
    where all leaves of the date with fewer are in one: then large ones were missed there."""
    if len(pairs) == pair.fewer:
        return 0.0
    is_large = pair.second.lengths >= np.median(pair.second.lengths)
    return ALIGN.large_new * float(np.delete(is_large, pairs[:, 1]).sum())


def near_world(pair: Pair, poses: Floats) -> Floats:
    """(H,) in [0, 1], how near poses (H, 4, 4) are to "as it stood"; 1 without leaves to tell."""
    if not pair.fewer:
        return np.ones(len(poses))
    return np.asarray(np.exp(-0.5 * pose_distances(pair, np.eye(4), poses) ** 2))


def pose_distances(pair: Pair, pose: Floats, others: Floats) -> Floats:
    """(H,) how far poses (H, 4, 4) are from one (4, 4), in units of one of the turns and, for the plant's middle, of
    how far the base of a leaf moves: below 1, they are one."""
    middle = np.append(pair.first.midribs.mean((0, 1)), 1.0)
    turned = np.arccos(np.clip((np.einsum("ij,hij->h", pose[:3, :3], others[:, :3, :3]) - 1) / 2, -1, 1))
    moved = np.linalg.norm((others - pose)[:, :3] @ middle, axis=1)
    return np.hypot(turned / (2 * np.pi / ALIGN.turns), moved / (POSES.across * pair.scale))


def draw_poses(pair: Pair) -> Floats:
    """(H, 4, 4) poses, one or more for every pair of leaves."""
    first, second = pair.first, pair.second
    one, other = np.repeat(np.arange(len(first)), len(second)), np.tile(np.arange(len(second)), len(first))
    poses = [np.zeros((0, 4, 4))]
    for ends in ((0, -1), (-1, 0)):  # the later midrib as it is, and from its other end where its base is not known
        keep = np.ones(len(one), bool) if ends[0] == 0 else ~(first.is_oriented[one] & second.is_oriented[other])
        i, j = one[keep], other[keep]
        start, end = second.midribs[j, ends[0]], second.midribs[j, ends[1]]
        ahead, before = end - start, first.midribs[i, -1] - first.midribs[i, 0]
        if pair.knows_up:
            turn = np.arctan2(ahead[:, 1], ahead[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
            turned = [Rotation.from_rotvec(turn[:, None] * (0, 0, 1)).as_matrix()]
        else:
            turned = [_frames(ahead, s * second.normals[j]) @ _frames(before, first.normals[i]).swapaxes(1, 2)
                      for s in (1, -1)]  # fmt: skip
        for rotation in turned:
            poses.append(make_poses(rotation, start - np.einsum("hij,hj->hi", rotation, first.midribs[i, 0])))
    return np.concatenate(poses)


def _frames(ahead: Floats, normal: Floats) -> Floats:
    """(H, 3, 3) right-handed frames, as columns, along a direction with a normal."""
    x = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    z = normal - (normal * x).sum(1, keepdims=True) * x
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], -1)


def make_poses(rotations: Floats, shifts: Floats) -> Floats:
    """(..., 4, 4) of rotations (..., 3, 3) and shifts (..., 3)."""
    poses = np.zeros((*shifts.shape[:-1], 4, 4))
    poses[..., :3, :3], poses[..., :3, 3], poses[..., 3, 3] = rotations, shifts, 1.0
    return poses


def alikeness(pair: Pair, poses: Floats) -> Floats:
    """(H, N + M) in [0, 1] how alike the most alike leaf of the other date is under each of the poses (H, 4, 4)."""
    first, second = pair.first, pair.second
    likeness = []
    for part in np.array_split(poses, 1 + len(poses) // 200):  # bounds the memory
        bases = np.einsum("hij,nj->hni", part[:, :3, :3], first.bases) + part[:, None, :3, 3]
        chords = np.einsum("hij,nj->hni", part[:, :3, :3], first.chords)
        away = np.square(bases[:, :, None] - second.bases).sum(-1) / (POSES.across * pair.scale) ** 2
        turn = 2 * (1 - np.einsum("hni,mi->hnm", chords, second.chords)) / POSES.turn**2
        alike = np.exp(-0.25 * (away + turn))
        likeness.append(np.concatenate([alike.max(2), alike.max(1)], 1))
    return np.concatenate(likeness)


def refine_alignment(pair: Pair, pose: Floats) -> Alignment:
    """From a pose (4, 4) that is nearly right: pair the leaves and fit it to the pairs, until these stay."""
    pairs = np.zeros((0, 2), int)
    for _ in range(ALIGN.rounds):
        costs, before = fitted_costs(pair.moved(pose)), pairs
        pairs = best_pairs(costs)
        if not len(pairs) or np.array_equal(pairs, before):
            break
        # what the pairs weigh as if nobody had said that they are one leaf
        own = np.maximum(pair.link_costs - costs, np.where(pair.link_costs < 0, ALIGN.least_weight, 0.0))
        pose = _fit(pair, pairs, own[pairs[:, 0], pairs[:, 1]], start=pose[:3, :3])
    else:
        costs = fitted_costs(pair.moved(pose))
        pairs = best_pairs(costs)
    return Alignment(pose, pairs, gain=float(-costs[pairs[:, 0], pairs[:, 1]].sum()))


def best_pairs(costs: Floats) -> np.ndarray:
    """(P, 2) the pairs, each leaf in one at most, whose costs (N, M) are below 0 and have the least sum."""
    rows, columns = linear_sum_assignment(np.minimum(costs, 0.0))
    keep = costs[rows, columns] < 0
    return np.stack([rows[keep], columns[keep]], 1)


def _fit(pair: Pair, pairs: np.ndarray, weights: Floats, *, start: Floats) -> Floats:
    """(4, 4) pose (weighted least squares) from bases and blades of the pairs; up stays nearly up."""
    first, second = pair.first, pair.second
    one, other = first.midribs[pairs[:, 0]], second.midribs[pairs[:, 1]].copy()
    reverse = np.linalg.norm(one @ start.T - other, axis=2).sum(1) > np.linalg.norm(
        one @ start.T - other[:, ::-1], axis=2).sum(1) + np.linalg.norm(other[:, 0] - other[:, -1], axis=1)  # fmt: skip
    other[reverse] = other[reverse][:, ::-1]
    share = first.lengths[pairs[:, 0]] / second.lengths[pairs[:, 1]]
    other = other[:, :1] + (other - other[:, :1]) * np.clip(share, 0.5, 2)[:, None, None]  # as long as it was
    places = [0, one.shape[1] // 2, -1]
    source, target = one[:, places].reshape(-1, 3), other[:, places].reshape(-1, 3)
    mass = (weights[:, None] * (1.0, 1.0, ALIGN.tip)).ravel()
    mass /= mass.sum()
    middle, aim = mass @ source, mass @ target
    source, target = source - middle, target - aim
    moment = (target * mass[:, None]).T @ source
    if pair.knows_up:
        up = [(0.0, 0.0, 1.0)]
        source, target = np.vstack([source, up]), np.vstack([target, up])
        mass = np.append(mass, ALIGN.upright / max(len(pairs), 1) * np.linalg.norm(moment))
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # on one line, any of the best will do
        rotation = Rotation.align_vectors(target, source, mass)[0].as_matrix()
    return make_poses(rotation, aim - rotation @ middle)
