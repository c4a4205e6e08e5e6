"""Where the plant of one date stands in the frame of another: the pot may have been turned, moved, set down askew.

Frames of different dates are never trusted: that they agree is one hypothesis among many. The others come from pairs of
leaves. Each is refined on the leaves that it pairs, and the best one must beat every different one clearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mvseg.tracking.costs import Leaves, pair_costs, typical_length
from mvseg.tracking.dates import Floats

NUM_REFINED = 40  # hypotheses, of those that look best
UPRIGHT = 2.0  # weight of "up stays up", in leaves
MOST_LEAN = np.radians(20.0)
COARSE = (0.18, 0.45, 0.5)  # scales of base (median lengths), direction (radians) and log length while searching
ROUNDS = (2.5, 1.8, 1.3, 1.0, 1.0)  # scales of the costs while refining
DIFFERENT = 0.34  # share of the pairs in which two hypotheses that are not the same differ, at least
LEAST_PAIRS = 3  # one pair of leaves fits any two plants, two fit many
WORLD_PRIOR, CHAIN_PRIOR = 5.0, 10.0  # log of how much likelier than any other pose it is that the world frames agree,
# and that two sure alignments by way of a date in between hold
NEAR, NEAR_SHIFT = np.radians(12.0), 0.3  # of such a pose: angle, and median lengths
SURE_MARGIN = 7.0  # of the best hypothesis over others
SURE_SUM, PER_LEAF = 23.5, 3.0  # of margin and PER_LEAF times the gain per leaf of the date with fewer leaves


@dataclass(frozen=True, eq=False)
class Alignment:
    """second_from_first of two dates.

    Attributes:
        rotation: (3, 3).
        shift: (3,).
        pairs: (P, 2) leaves of the two dates (rows of `Leaves`) that go together.
        gain: how much likelier these pairs are the same leaves than strangers, a natural logarithm.
        margin: by how much `gain` is larger than that of the best hypothesis with other pairs.
        reason: why it is not to be trusted; "" for a sure one.
    """

    rotation: Floats
    shift: Floats
    pairs: np.ndarray
    gain: float
    margin: float
    reason: str = ""

    @property
    def is_sure(self) -> bool:
        return not self.reason


def align(first: Leaves, second: Leaves, *, days: float, knows_up: bool, guess: Alignment | None = None) -> Alignment:
    """The best alignment of two dates, and whether it is sure.

    Args:
        first, second: N and M leaves, each in its date's frame.
        days: between the dates.
        knows_up: +z is up in both frames; else any rotation is looked at.
        guess: another hypothesis, from dates in between.
    """
    if min(len(first), len(second)) < LEAST_PAIRS:
        few = min(len(first), len(second))
        reason = f"{few or 'no'} {'leaf' if few == 1 else 'leaves'} cannot tell how the pot stands"
        return Alignment(np.eye(3), np.zeros(3), np.zeros((0, 2), int), 0.0, 0.0, reason)
    scale = typical_length(first, second)
    rotations, shifts = _hypotheses(first, second, knows_up=knows_up)
    if guess is not None:
        rotations, shifts = np.concatenate([guess.rotation[None], rotations]), np.vstack([guess.shift, shifts])
    scores = _coarse_scores(first, second, rotations, shifts, scale=scale)
    scores[: 1 + (guess is not None)] += 1e6  # always looked at
    found = []
    for index in np.argsort(-scores, kind="stable")[:NUM_REFINED]:
        pose = rotations[index], shifts[index]
        found.append(_refine(first, second, pose, days=days, scale=scale, knows_up=knows_up))
    expected = [(np.eye(3), np.zeros(3), WORLD_PRIOR)]
    if guess is not None:
        expected.append((guess.rotation, guess.shift, CHAIN_PRIOR))
    middle = first.midribs.mean((0, 1))
    priors = [max(_prior(pose, *each, middle=middle, scale=scale) for each in expected) for pose in found]
    return _best(found, priors, min(len(first), len(second)))


def _prior(pose: Alignment, rotation: Floats, shift: Floats, prior: float, *, middle: Floats, scale: float) -> float:
    """`prior` if a pose is near an expected one, or else 0."""
    turned = np.arccos(np.clip((np.trace(rotation.T @ pose.rotation) - 1) / 2, -1, 1))
    moved = np.linalg.norm(pose.rotation @ middle + pose.shift - rotation @ middle - shift)
    return prior if turned < NEAR and moved < NEAR_SHIFT * scale else 0.0


def _best(found: list[Alignment], priors: list[float], smaller: int) -> Alignment:
    """The likeliest hypothesis, its margin over those that differ, and what speaks against it.

    `smaller` is the number of leaves of the date with fewer ones.
    """
    place = max(range(len(found)), key=lambda n: found[n].gain + priors[n])
    best = found[place]
    pairs = {tuple(pair) for pair in best.pairs.tolist()}
    others = [
        other.gain + prior
        for other, prior in zip(found, priors, strict=True)
        if len(pairs & {tuple(pair) for pair in other.pairs.tolist()}) < (1 - DIFFERENT) * max(len(pairs), 1)
    ]
    margin = best.gain + priors[place] - max(others, default=0.0)
    reason = ""
    if len(pairs) < max(LEAST_PAIRS, 0.4 * smaller):
        reason = f"only {len(pairs)} of {smaller} leaves are alike, however the pot is turned"
    elif margin < SURE_MARGIN:
        reason = "the pot could be turned in more than one way"
    elif margin + PER_LEAF * best.gain / smaller < SURE_SUM:
        reason = "the leaves are not alike enough, however the pot is turned"
    return Alignment(best.rotation, best.shift, best.pairs, best.gain, margin, reason)


def _hypotheses(first: Leaves, second: Leaves, *, knows_up: bool) -> tuple[Floats, Floats]:
    """(H, 3, 3) rotations and (H, 3) shifts: the world's own first, then one or more for every pair of leaves."""
    one, other = np.repeat(np.arange(len(first)), len(second)), np.tile(np.arange(len(second)), len(first))
    ratio = np.abs(np.log(second.lengths[other] / first.lengths[one]))
    one, other = one[ratio < 1.2], other[ratio < 1.2]
    rotations, shifts = [np.eye(3)[None]], [np.zeros((1, 3))]
    for ends in ((0, -1), (-1, 0)):  # the later midrib as it is, and from its other end where its base is not known
        keep = np.ones(len(one), bool) if ends[0] == 0 else ~(first.is_oriented[one] & second.is_oriented[other])
        i, j = one[keep], other[keep]
        start, end = second.midribs[j, ends[0]], second.midribs[j, ends[1]]
        ahead, before = end - start, first.midribs[i, -1] - first.midribs[i, 0]
        if knows_up:
            turn = np.arctan2(ahead[:, 1], ahead[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
            turned = [_yaw(turn)]
        else:
            turned = [_frames(ahead, s * second.normals[j]) @ _frames(before, first.normals[i]).swapaxes(1, 2)
                      for s in (1, -1)]  # fmt: skip
        for rotation in turned:
            rotations.append(rotation)
            shifts.append(start - np.einsum("hij,hj->hi", rotation, first.midribs[i, 0]))
    return np.concatenate(rotations), np.concatenate(shifts)


def _yaw(angles: Floats) -> Floats:
    """(H, 3, 3) rotations about +z."""
    cos, sin = np.cos(angles), np.sin(angles)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    return np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1).reshape(-1, 3, 3)


def _frames(ahead: Floats, normal: Floats) -> Floats:
    """(H, 3, 3) right-handed frames, as columns, along a direction with a normal."""
    x = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    z = normal - (normal * x).sum(1, keepdims=True) * x
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], -1)


def _coarse_scores(first: Leaves, second: Leaves, rotations: Floats, shifts: Floats, *, scale: float) -> Floats:
    """(H,) how many leaves find one like them under each hypothesis, softly."""
    size = np.square(np.log(second.lengths[None] / first.lengths[:, None]) / COARSE[2])
    scores = []
    for rotation, shift in zip(
        np.array_split(rotations, 1 + len(rotations) // 200), np.array_split(shifts, 1 + len(rotations) // 200),
        strict=True,
    ):  # fmt: skip
        bases = np.einsum("hij,nj->hni", rotation, first.bases) + shift[:, None]
        chords = np.einsum("hij,nj->hni", rotation, first.chords)
        away = np.square(bases[:, :, None] - second.bases).sum(-1) / (COARSE[0] * scale) ** 2
        turn = 2 * (1 - np.einsum("hni,mi->hnm", chords, second.chords)) / COARSE[1] ** 2
        alike = np.exp(-0.25 * (away + turn + size))
        scores.append(alike.max(2).sum(1) + alike.max(1).sum(1))
    return np.concatenate(scores)


def _refine(
    first: Leaves, second: Leaves, pose: tuple[Floats, Floats], *, days: float, scale: float, knows_up: bool
) -> Alignment:
    """Pair the leaves, fit the pose to the pairs, and again with stricter costs."""
    rotation, shift = pose
    for spread in ROUNDS:
        costs = pair_costs(first.moved(rotation, shift), second, days=days, scale=scale, spread=spread)
        pairs = best_pairs(costs)
        if not len(pairs):
            return Alignment(rotation, shift, pairs, 0.0, 0.0)
        if spread > ROUNDS[-1] or len(pairs) > 1:
            weights = np.minimum(-costs[pairs[:, 0], pairs[:, 1]], 6.0)
            rotation, shift = _fit(first, second, pairs, weights, knows_up=knows_up, start=rotation)
    costs = pair_costs(first.moved(rotation, shift), second, days=days, scale=scale)
    pairs = best_pairs(costs)
    return Alignment(rotation, shift, pairs, float(-costs[pairs[:, 0], pairs[:, 1]].sum()), 0.0)


def best_pairs(costs: Floats) -> np.ndarray:
    """(P, 2) the pairs, each leaf in one at most, whose costs (N, M) are below 0 and have the least sum."""
    rows, columns = linear_sum_assignment(np.minimum(costs, 0.0))
    keep = costs[rows, columns] < 0
    return np.stack([rows[keep], columns[keep]], 1)


def _fit(
    first: Leaves, second: Leaves, pairs: np.ndarray, weights: Floats, *, knows_up: bool, start: Floats
) -> tuple[Floats, Floats]:
    """Rotation and shift (weighted least squares) from bases and blades of the pairs; up stays nearly up."""
    one, other = first.midribs[pairs[:, 0]], second.midribs[pairs[:, 1]].copy()
    reverse = np.linalg.norm(one @ start.T - other, axis=2).sum(1) > np.linalg.norm(
        one @ start.T - other[:, ::-1], axis=2).sum(1) + np.linalg.norm(other[:, 0] - other[:, -1], axis=1)  # fmt: skip
    other[reverse] = other[reverse][:, ::-1]
    share = first.lengths[pairs[:, 0]] / second.lengths[pairs[:, 1]]
    other = other[:, :1] + (other - other[:, :1]) * np.clip(share, 0.5, 2)[:, None, None]  # as long as it was
    places = [0, one.shape[1] // 2, -1]
    source, target = one[:, places].reshape(-1, 3), other[:, places].reshape(-1, 3)
    mass = (weights[:, None] * (1.0, 0.4, 0.15)).ravel()
    mass /= mass.sum()
    middle, aim = mass @ source, mass @ target
    moment = (target - aim).T @ ((source - middle) * mass[:, None])
    if knows_up:
        extent = np.sqrt(np.trace(moment.T @ moment))
        held = moment + UPRIGHT / max(len(pairs), 1) * extent * np.outer((0, 0, 1), (0, 0, 1))
        rotation = _kabsch(held)
        if np.arccos(np.clip(rotation[2, 2], -1, 1)) > MOST_LEAN:
            turn = np.arctan2(moment[1, 0] - moment[0, 1], moment[0, 0] + moment[1, 1])
            rotation = _yaw(np.array([turn]))[0]
    else:
        rotation = _kabsch(moment)
    return rotation, aim - rotation @ middle


def _kabsch(moment: Floats) -> Floats:
    """The rotation R with the largest trace of R^T moment."""
    left, _, right = np.linalg.svd(moment)
    sign = np.sign(np.linalg.det(left @ right)) or 1.0
    rotation: Floats = left @ np.diag([1.0, 1.0, sign]) @ right
    return rotation
