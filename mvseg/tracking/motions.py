"""Leaves that moved otherwise than the rest between two dates: a second plant in the pot, a shoot that was bent.

One pose cannot hold for both. The leaves that it does not explain are then linked with others that happen to stand
where they stood, and nothing in their costs says so. So every alignment is held against a second motion: a pose of
some leaves under which both together are far likelier.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvseg.tracking.align import alikeness, best_pairs, draw_poses, pose_distances, refine_alignment
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import LINKS, fitted_costs
from mvseg.tracking.leaves import Pair
from mvseg.tracking.numbers import ALIGN, MOTIONS


@dataclass(frozen=True, eq=False)
class Motion:
    """How some leaves of a date moved to another one, otherwise than the rest.

    Attributes:
        pose: (4, 4) second_from_first.
        pairs: (P, 2) these leaves on the two dates (rows of `Leaves`).
        gain: how much likelier it is that they moved so than with the rest, a natural logarithm.
        margin: by how much it is likelier than that they moved in the best way that pairs them otherwise.
    """

    pose: Floats
    pairs: np.ndarray
    gain: float
    margin: float

    @property
    def is_sure(self) -> bool:
        return self.margin >= MOTIONS.sure_margin


def find_motion(pair: Pair, pose: Floats) -> Motion | None:
    """The best second motion of dates that are aligned by a pose (4, 4); None where one is enough."""
    if not pair.fewer:
        return None
    poses = np.concatenate([pose[None], draw_poses(pair)])
    alike = alikeness(pair, poses)[:, : len(pair.first)]
    better = np.maximum(alike - alike[0], 0).sum(1)
    better[pose_distances(pair, pose, poses) < 1] = 0
    costs = fitted_costs(pair.moved(pose), LINKS)
    alone, motions = _total(costs), []
    unpaired = np.argsort(-better, kind="stable")
    for _ in range(ALIGN.num_refined):
        if not len(unpaired) or not better[unpaired[0]]:
            break
        at, own = poses[unpaired[0]], np.flatnonzero(alike[unpaired[0]] > alike[0])
        unpaired = unpaired[pose_distances(pair, at, poses[unpaired]) >= 1]
        refined = refine_alignment(pair.take(own, np.arange(len(pair.second))), at)
        if pose_distances(pair, pose, refined.pose[None])[0] >= 1:
            others = fitted_costs(pair.moved(refined.pose), LINKS)
            rows, columns = best_pairs(np.minimum(costs, others)).T
            keep = others[rows, columns] < costs[rows, columns]
            pairs = np.stack([rows[keep], columns[keep]], 1)
            motions.append(Motion(refined.pose, pairs, alone - _total(np.minimum(costs, others)), margin=0.0))
    best = max(motions, key=lambda motion: motion.gain, default=None)
    if best is None or best.gain < MOTIONS.least_gain:
        return None
    rivals = (motion.gain for motion in motions if _contradicts(motion.pairs, best.pairs))
    return Motion(best.pose, best.pairs, best.gain, margin=best.gain - max(rivals, default=0.0))


def _total(costs: Floats) -> float:
    return float(costs[tuple(best_pairs(costs).T)].sum())


def _contradicts(pairs: np.ndarray, others: np.ndarray) -> bool:
    """Does the one pair half of the leaves of the others with different ones?"""
    clashes = (pairs[:, None] == others).sum(2) == 1  # one leaf of two in common
    return bool(2 * clashes.any(1).sum() >= len(others))
