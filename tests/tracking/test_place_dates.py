"""Where all dates stand: what two dates alone get wrong, the others put right."""

from __future__ import annotations

from functools import cache
from itertools import combinations
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvseg.tracking.align import Alignment, Poses, list_poses, make_poses
from mvseg.tracking.leaves import Pair, leaves_of
from mvseg.tracking.place_dates import place_dates
from tests.plants_over_days import grow_blades, grown, see

BLADES = grow_blades(7, 3)
HALF_TURN = Rotation.from_euler("z", 180, degrees=True).as_matrix()
TURNS = (0.0, 80.0, 200.0, 200.0)


@cache
def look_at(turns: tuple[float, ...]) -> dict[tuple[int, int], Poses]:
    leaves = [leaves_of(see(grown(BLADES, 1 + 0.05 * n), n, turn=turn)[0]) for n, turn in enumerate(turns)]
    return {(a, b): list_poses(Pair.of(leaves[a], leaves[b], days=b - a, knows_up=True))
            for a, b in combinations(range(len(turns)), 2)}  # fmt: skip


def turns_of(poses: np.ndarray) -> np.ndarray:
    """How far the pot is turned on each date, degrees."""
    return np.degrees(np.arctan2(poses[:, 0, 1], poses[:, 0, 0])).round(6) % 360


def test_all_dates_are_placed_and_sure_of_it() -> None:
    poses, roots, steady = place_dates(4, look_at(TURNS))
    np.testing.assert_allclose(turns_of(poses), TURNS, atol=5)
    assert roots.tolist() == [0] * 4
    assert steady.min() > 0.9


@pytest.mark.parametrize("wrong", [(0, 1), (1, 2), (2, 3)])
def test_two_dates_that_look_alike_in_a_wrong_way_are_settled_by_the_others(wrong: tuple[int, int]) -> None:
    looked = look_at(TURNS)
    there = looked[wrong]
    away = make_poses(Rotation.from_euler("z", 120, degrees=True).as_matrix(), np.array([5.0, 0, 0]))
    other = Alignment(away, there.best.pairs, there.best.costs - 5)
    likelier = Poses(there.pair, (*there.refined, other), np.append(there.odds, there.odds.max() + 10))
    assert likelier.best is other
    poses, _, _ = place_dates(4, {**looked, wrong: likelier})
    np.testing.assert_allclose(turns_of(poses), TURNS, atol=5)


@pytest.mark.parametrize("date", range(4))
def test_one_date_that_stands_wrong_to_all_others_is_moved_the_first_one_too(date: int) -> None:
    looked, start = look_at(TURNS), place_dates(4, look_at(TURNS))[0]
    start[date] = start[date] @ make_poses(HALF_TURN, np.zeros(3))
    with patch("mvseg.tracking.place_dates.chain_dates", return_value=(start, np.zeros(4, int))):
        poses, _, _ = place_dates(4, looked)
    np.testing.assert_allclose(turns_of(poses), TURNS, atol=5)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)


def test_later_dates_that_stand_wrong_together_are_moved_together() -> None:
    """Leaves grew much in between: one date alone would lose more than it gains."""
    leaves = [leaves_of(see(grown(BLADES, size), n, turn=0)[0]) for n, size in enumerate((1, 1.01, 1.7, 1.71))]
    steps = {(n, n + 1): list_poses(Pair.of(leaves[n], leaves[n + 1], days=1, knows_up=True)) for n in range(3)}
    start = np.stack([np.eye(4)] * 2 + [make_poses(HALF_TURN, np.zeros(3))] * 2)
    with patch("mvseg.tracking.place_dates.chain_dates", return_value=(start, np.zeros(4, int))):
        poses, _, _ = place_dates(4, steps)
    assert poses[:, 0, 0].min() > 0.99
