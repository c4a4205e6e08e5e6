"""Pots and tubes: points above the soil, and radii as asked for."""

from __future__ import annotations

import numpy as np
import pytest

from mvseg.simulation.pot import Pot, lift, make_tube, revolve

POT = Pot(radius=50.0, height=80.0, sides=48)


@pytest.mark.parametrize(("distance", "floor"), [(0.0, 4.0), (50.0, 4.0), (200.0, 4.0 - 80.0)])
def test_points_are_lifted_above_soil_and_ground_in_their_order(distance: float, floor: float) -> None:
    z = np.linspace(-200, 100, 40)
    points = np.stack([np.full_like(z, distance), 0 * z, z], 1)
    lifted = lift(POT, points)
    assert np.array_equal(lifted[:, :2], points[:, :2])
    assert (lifted[:, 2] >= floor).all()
    assert (np.diff(lifted[lifted[:, 2] > floor + 1e-9, 2]) > 0).all()
    high = z > floor + 60
    assert lifted[high, 2] == pytest.approx(z[high])


def test_tube_tapers_around_its_points() -> None:
    points = np.linspace([1.0, 2.0, 3.0], [1.0, 2.0, 13.0], 5)
    tube = make_tube("stem", points, radius=2.0, taper=0.5)
    distance = np.linalg.norm(tube.vertices.reshape(5, -1, 3) - points[:, None], axis=2)
    assert distance == pytest.approx(np.repeat([[2.0], [1.75], [1.5], [1.25], [1.0]], distance.shape[1], axis=1))


def test_turned_profile_has_its_radii_and_heights() -> None:
    cone = revolve("pot", [(3.0, 0.0), (1.0, 5.0)], sides=4, bumps=np.array([[0.0] * 4, [0.5] * 4]))
    assert np.linalg.norm(cone.vertices[:, :2], axis=1) == pytest.approx([3.0] * 4 + [1.0] * 4)
    assert cone.vertices[:, 2] == pytest.approx([0.0] * 4 + [5.5] * 4)
    assert len(cone.faces) == 8
