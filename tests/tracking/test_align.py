"""Aligning dates: any pot, and how likely that is right."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.tracking import see_series
from mvseg.simulation.series import draw_specs
from mvseg.tracking.align import Alignment, guess_chance, list_poses
from mvseg.tracking.leaves import Pair, leaves_of
from mvseg.tracking.numbers import ALIGN
from tests.plants_over_days import grow_blades, grown, see

BLADES_OF_8 = grow_blades(8, 3)

SURE = 0.9


def align(pair: Pair) -> tuple[Alignment, float]:
    """The likeliest one, and its probability."""
    best = list_poses(pair).best
    return best, guess_chance(pair, best)


@pytest.mark.parametrize(("turn", "lean"), [(0, 0), (75, 0), (180, 8), (300, 15)])
def test_a_pot_that_was_turned_moved_and_leans(turn: float, lean: float) -> None:
    blades = grow_blades(9, 3)
    first, one = see(blades, 0)
    second, other = see(grown(blades, 1.1), 2, turn=turn, lean=lean, shift=(200, -80, 15))
    alignment, probability = align(Pair.of(leaves_of(first), leaves_of(second), days=2, knows_up=True))
    assert probability > SURE
    assert [one[i] for i, _ in alignment.pairs] == [other[j] for _, j in alignment.pairs]
    assert len(alignment.pairs) == 9
    true = Rotation.from_euler("zx", [turn, lean], degrees=True).as_matrix()
    assert np.degrees(Rotation.from_matrix(alignment.pose[:3, :3].T @ true).magnitude()) < 4
    np.testing.assert_allclose(alignment.pose[:3, 3], (200, -80, 15), atol=15)


def test_up_need_not_be_known() -> None:
    blades = grow_blades(9, 3)
    first, one = see(blades, 0)
    second, other = see(blades, 2, turn=40, lean=120, shift=(0, 0, 500))
    alignment, probability = align(Pair.of(leaves_of(first), leaves_of(second), days=2, knows_up=False))
    assert probability > SURE
    assert [one[i] for i, _ in alignment.pairs] == [other[j] for _, j in alignment.pairs]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_leaves_hardly_tell(count: int) -> None:
    blades = grow_blades(count, 3)
    first = leaves_of(see(grow_blades(5, 3), 0)[0])
    alignment, probability = align(Pair.of(first, leaves_of(see(blades, 1)[0]), days=1, knows_up=True))
    np.testing.assert_allclose(alignment.pose, np.eye(4), atol=1e-9)
    assert count or 0.5 < probability < SURE


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_another_plant_in_the_pot_is_less_likely_than_the_same_one(seed: int) -> None:
    """Even one that grew by the same rule, and has as many leaves."""
    first, *later = (leaves_of(see(blades, n)[0]) for n, blades in enumerate(
        (BLADES_OF_8, grown(BLADES_OF_8, 1.05), grow_blades(8, seed))))  # fmt: skip
    same, other = (align(Pair.of(first, each, days=1, knows_up=True))[1] for each in later)
    assert other < ALIGN.told < 0.99 < same


@pytest.mark.parametrize("pair", [(0, 2), (1, 3)])
def test_a_plant_is_not_aligned_with_its_own_older_leaves(pair: tuple[int, int]) -> None:
    """A compound plant that doubles in days: its young leaves then look as the older ones did, a turn further."""
    dates, truth = see_series(draw_specs(5, seed=3)[4])
    (one, true), (other, later) = ((leaves_of(dates[n]), truth[n]) for n in pair)
    days = dates[pair[1]].time - dates[pair[0]].time
    alignment, probability = align(Pair.of(one, other, days=days, knows_up=True))
    right = [true[one.index[i]] == later[other.index[j]] for i, j in alignment.pairs]
    assert probability < 0.9 or np.mean(right) > 0.5


def test_leaves_that_were_missed_before_do_no_harm() -> None:
    plant = grow_blades(12, 3)
    first, one = see({leaf: plant[leaf] for leaf in (2, 4, 5, 7, 9, 11)}, 0)
    second, other = see(plant, 2, turn=75)
    alignment, probability = align(Pair.of(leaves_of(first), leaves_of(second), days=2, knows_up=True))
    assert probability > SURE
    assert [one[i] for i, _ in alignment.pairs] == [other[j] for _, j in alignment.pairs]
