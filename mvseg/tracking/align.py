"""The plant of one date in the frame of another: the pot may have been turned, moved, set down askew.

That the pot stands as it stood is one hypothesis among many; the others come from pairs of leaves. Each is refined on
the leaves that it pairs. Its log odds follow from how well they go together, and from a prior that the pot stands. How
far to trust the pose that is taken in the end says `guess_chance`.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from scipy.special import expit

from mvseg.arrays import Floats
from mvseg.tracking.fitted_costs import POSES, fitted_costs
from mvseg.tracking.leaves import Pair
from mvseg.tracking.numbers import ALIGN

GUESS = (-2.02, 0.99, 2.05)  # fitted: python -m benchmarks.fit_chances; offset, own and strange gain


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pose of the plant of one date on another.

    Attributes:
        pose: (4, 4) second_from_first, a rotation and a shift.
        pairs: (P, 2) leaves of the two dates (rows of `DateLeaves`) that go together.
        costs: (P,) of these pairs, all below 0.
    """

    pose: Floats
    pairs: np.ndarray
    costs: Floats

    @property
    def gain(self) -> float:
        """How much likelier the pairs are the same leaves than strangers, a natural logarithm."""
        return float(-self.costs.sum())


@dataclass(frozen=True, eq=False)
class Poses:
    """H poses of one pair of dates, the first as it stood, that were looked at; `odds` (H,) see `pose_odds`."""

    pair: Pair
    refined: tuple[Alignment, ...]
    odds: Floats

    @property
    def best(self) -> Alignment:
        """The likeliest one by these two dates alone."""
        return self.refined[int(np.round(self.odds, ALIGN.digits).argmax())]


def list_poses(pair: Pair) -> Poses:
    """The poses of two dates, each in its own frame, that look best, and those suggested by leaves that the user links,
    each refined; where up is not known, of any rotation. Without leaves on one date, only "as it stood"."""
    refined = [align_at(pair, np.eye(4))]
    if pair.fewer:
        asked = [draw_poses(replace(pair, first=pair.first.select(row), second=pair.second.select(column)))
                 for row, column in np.argwhere(pair.link_costs < 0)[..., None]]  # fmt: skip
        looked_at = np.concatenate([np.eye(4)[None], *asked])
        poses = np.concatenate([looked_at, draw_poses(pair)])
        rank = np.repeat([0, 1, 2], [1, len(looked_at) - 1, len(poses) - len(looked_at)])  # the first ones in any case
        left = np.lexsort((-alikeness(pair, poses).sum(1), rank))
        while len(left) and len(refined) < ALIGN.num_refined:
            refined.append(refine_alignment(pair, poses[left[0]]))
            left = left[pose_distances(pair, poses[left[0]], poses[left]) >= 1]
    return Poses(pair, tuple(refined), np.array([pose_odds(pair, each) for each in refined]))


def pose_odds(pair: Pair, alignment: Alignment) -> float:
    """Log odds of a pose of two dates: by its gain, by large new leaves, and by the prior that the pot stands.

    Leaves of the larger half that are in no pair cost something, as when a plant is turned onto its own older leaves;
    not where all leaves of the date with fewer are in one: then large ones were missed there. The prior counts by how
    near the pose is to "as it stood".
    """
    gain, near = alignment.gain, 1.0
    if len(alignment.pairs) < pair.fewer:
        is_large = pair.second.lengths >= np.median(pair.second.lengths)
        gain -= ALIGN.large_new * float(np.delete(is_large, alignment.pairs[:, 1]).sum())
    if pair.fewer:
        near = float(np.exp(-0.5 * pose_distances(pair, np.eye(4), alignment.pose[None])[0] ** 2))
    return ALIGN.temper * gain + pair.still * near


def guess_chance(pair: Pair, alignment: Alignment) -> float:
    """How likely a pose is right.

    Its gain tells; that of another plant is low. (Once all dates are placed, how likely the pose is among others of the
    two dates says nothing more.) Leaves are neither independent, then the sum of their evidence would count, nor all
    the same, then the mean would: the sum counts over the root of the number of leaves of the date with fewer. Without
    leaves only the prior tells.
    """
    if not pair.fewer:
        return float(expit(pair.still - math.log(ALIGN.turns)))
    offset, own, strange = GUESS
    return float(expit(offset + (own * alignment.gain / pair.fewer - strange) * math.sqrt(pair.fewer)))


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


def align_at(pair: Pair, pose: Floats) -> Alignment:
    """The leaves that go together under a pose (4, 4)."""
    costs = fitted_costs(pair.moved(pose))
    pairs = best_pairs(costs)
    return Alignment(pose, pairs, costs[pairs[:, 0], pairs[:, 1]])


def refine_alignment(pair: Pair, pose: Floats) -> Alignment:
    """From a pose (4, 4) that is nearly right: pair the leaves and fit it to the pairs, until these stay."""
    now, before = align_at(pair, pose), np.zeros((0, 2), int)
    for _ in range(ALIGN.rounds):
        if not len(now.pairs) or np.array_equal(now.pairs, before):
            break
        links = pair.link_costs[now.pairs[:, 0], now.pairs[:, 1]]
        # what the pairs weigh as if nobody had said that they are one leaf
        weights = np.maximum(links - now.costs, np.where(links < 0, ALIGN.least_weight, 0.0))
        before, now = now.pairs, align_at(pair, _fit(pair, now.pairs, weights, start=now.pose[:3, :3]))
    return now


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
