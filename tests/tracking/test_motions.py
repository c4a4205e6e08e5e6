"""Leaves that moved otherwise than the rest: found where there are some, not where leaves only grew."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvseg.tracking.align import make_poses
from mvseg.tracking.leaves import DateLeaves, Pair, leaves_of
from mvseg.tracking.motions import Motion, find_motion
from tests.plants_over_days import Blades, grow_blades, grown, see

TURN = Rotation.from_euler("z", 40, degrees=True).as_matrix()
POSE = make_poses(TURN, np.zeros(3))  # of the pot, where it is turned by 40 degrees


def motion_of(first: Blades, second: Blades) -> tuple[Motion | None, list[int], list[int]]:
    (one, truth), (other, later) = see(first, 0), see(second, 2, turn=40)
    return find_motion(Pair.of(leaves_of(one), leaves_of(other), days=2, knows_up=True), POSE), truth, later


@pytest.mark.parametrize("seed", range(4))
def test_a_plant_that_grew_moved_as_one(seed: int) -> None:
    plant = grow_blades(12, seed)
    factors = np.random.default_rng(seed).uniform(1.0, 1.4, 12)
    later = {leaf: grown({leaf: blade}, factors[leaf - 1])[leaf] for leaf, blade in plant.items() if leaf != 3}
    assert motion_of(plant, later)[0] is None


def test_a_shoot_that_was_twisted_is_found_with_its_pose() -> None:
    plant = grow_blades(14, 2)
    twisted = Rotation.from_euler("zy", [50, 8], degrees=True)
    later = {leaf: twisted.apply((blade - (0, 0, 190)).reshape(-1, 3)).reshape(blade.shape) + (0, 0, 190) if leaf > 8
             else blade for leaf, blade in plant.items()}  # fmt: skip
    motion, truth, seen = motion_of(plant, later)
    assert motion is not None
    assert motion.is_sure
    assert sorted(truth[row] for row in motion.pairs[:, 0]) == [9, 10, 11, 12, 13, 14]
    assert [truth[row] for row, _ in motion.pairs] == [seen[row] for _, row in motion.pairs]
    off = Rotation.from_matrix(motion.pose[:3, :3].T @ TURN @ twisted.as_matrix())
    assert np.degrees(off.magnitude()) < 6


def test_without_leaves_nothing_moved() -> None:
    assert motion_of({}, grow_blades(4, 1))[0] is None
    assert motion_of(grow_blades(4, 1), {})[0] is None


def test_some_of_the_leaves_are_taken() -> None:
    leaves = leaves_of(see(grow_blades(5, 1), 0)[0])
    some = leaves.take(np.array([3, 1]))
    assert len(some) == 2
    for field in fields(DateLeaves):
        np.testing.assert_array_equal(getattr(some, field.name), getattr(leaves, field.name)[[3, 1]])
