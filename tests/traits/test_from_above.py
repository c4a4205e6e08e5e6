from __future__ import annotations

import numpy as np
import pytest

from known_leaves import bent_blade, fit_coefficients, flat_leaf, flat_sheet, make_surface, move, turn_about
from mvseg.traits.from_above import look_from_above
from mvseg.traits.up import level_frame

FRAME = level_frame((0.0, 0.0, 1.0))
ELLIPSE = np.pi * 20 * 10


def test_flat_leaves_side_by_side_are_lit_and_cover_their_area() -> None:
    cells = look_from_above({1: flat_leaf(), 4: flat_leaf(at=(0, 30, 5))}, FRAME)
    for leaf in cells.values():
        assert leaf.lit_share == pytest.approx(1, abs=1e-3)
        assert leaf.projected_area == pytest.approx(ELLIPSE, rel=3e-3)


def test_a_leaf_in_the_shade_covers_nothing() -> None:
    """The upper one is larger and hides the lower one whole; the order of the ids does not matter."""
    upper = flat_leaf(length=60, half_width=15, at=(-10, 0, 8))
    for surfaces in ({1: upper, 2: flat_leaf()}, {1: flat_leaf(), 2: upper}):
        cells = look_from_above(surfaces, FRAME)
        shares = {surface is upper: cells[instance].lit_share for instance, surface in surfaces.items()}
        assert shares == {True: pytest.approx(1, abs=1e-3), False: pytest.approx(0, abs=1e-3)}


def test_half_a_leaf_in_the_shade() -> None:
    """The upper leaf is so wide that its edge is nearly straight, across the middle of the lower one."""
    upper = flat_leaf(length=400, half_width=200, at=(20, 0, 5))
    lower = look_from_above({1: upper, 2: flat_leaf()}, FRAME)[2]
    assert lower.lit_share == pytest.approx(0.5, abs=0.03)
    assert lower.projected_area == pytest.approx(ELLIPSE / 2, rel=0.06)


@pytest.mark.parametrize("tilt", [30.0, 60.0, 85.0])
def test_steep_leaves_cover_less(tilt: float) -> None:
    surface = move(flat_leaf(), turn_about(np.array([0, 1.0, 0]), tilt))
    (leaf,) = look_from_above({1: surface}, FRAME).values()
    assert leaf.projected_area == pytest.approx(ELLIPSE * np.cos(np.radians(tilt)), rel=0.01)
    assert leaf.lit_share == pytest.approx(1, abs=1e-3)


def test_a_leaf_hides_its_own_tip() -> None:
    """Bent by 180 degrees over a cylinder: the lower half is in the shade of the upper one."""
    surface = bent_blade(bend_deg=180, length=60)
    (leaf,) = look_from_above({1: surface}, FRAME).values()
    assert leaf.lit_share == pytest.approx(0.5, abs=0.05)


def test_shares_do_not_depend_on_place_turn_and_scale() -> None:
    rng = np.random.default_rng(0)
    coefficients = fit_coefficients(flat_sheet, length=40, half_width=10)
    leaves = {
        i: move(make_surface(coefficients), turn_about(rng.normal(size=3), 40), shift=tuple(rng.normal(0, 15, 3)))
        for i in range(1, 7)
    }
    first = look_from_above(leaves, FRAME)
    turn = turn_about(np.array([0, 0, 1.0]), 50)
    second = look_from_above({i: move(s, turn, scale=7, shift=(500, 0, -80)) for i, s in leaves.items()}, FRAME)
    assert min(leaf.lit_share for leaf in first.values()) < 0.8  # some are hidden in part
    for i in leaves:
        assert second[i].lit_share == pytest.approx(first[i].lit_share, abs=0.02)
        assert second[i].projected_area == pytest.approx(49 * first[i].projected_area, abs=49 * 0.02 * ELLIPSE)


def test_small_leaves_beside_large_ones_are_lit() -> None:
    """Their cells are smaller than the pixels of the picture."""
    small = move(bent_blade(length=8, half_width=2), turn_about(np.array([1.0, 0, 0]), 30), shift=(0, 900, 0))
    cells = look_from_above({1: small, 2: flat_leaf(length=900, half_width=300)}, FRAME)
    assert cells[1].lit_share > 0.99


def test_no_leaves() -> None:
    assert look_from_above({}, FRAME) == {}
