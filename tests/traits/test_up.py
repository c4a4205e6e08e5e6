from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from blade_scene import ring_cameras
from known_leaves import turn_about
from mvseg.errors import InputError
from mvseg.scene import Cameras, Scene, View
from mvseg.traits.up import find_up, level_frame, up_of_cameras


def turned(cameras: Cameras, turn: np.ndarray) -> Cameras:
    """The same photos in a world that is turned."""
    return replace(cameras, R=cameras.R @ torch.from_numpy(turn).T)


def rolled(cameras: Cameras, degrees: list[float]) -> Cameras:
    """Every camera rolled about its own axis."""
    rolls = np.stack([turn_about(np.array([0, 0, 1.0]), angle) for angle in degrees])
    rolls = torch.from_numpy(rolls)
    return replace(cameras, R=rolls @ cameras.R, t=(rolls @ cameras.t[:, :, None])[:, :, 0])


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 1.0, 0), (1.0, 2.0, 3.0)])
@pytest.mark.parametrize("degrees", [0.0, 100.0, 180.0])
def test_level_cameras_tell_which_way_is_up(axis: tuple[float, float, float], degrees: float) -> None:
    turn = turn_about(np.array(axis), degrees)
    assert up_of_cameras(turned(ring_cameras(6), turn)) == pytest.approx(turn[:, 2], abs=1e-9)


def test_some_roll_is_evened_out() -> None:
    rolls = [3.0, -2.0, 1.0, -3.0, 2.0, -1.0, 2.0, -2.0]
    up = up_of_cameras(rolled(ring_cameras(8), rolls))
    assert np.degrees(np.arccos(up[2])) < 2
    assert up_of_cameras(ring_cameras(4)[[0, 1]])[2] == pytest.approx(1)


@pytest.mark.parametrize(
    ("cameras", "reason"),
    [
        (ring_cameras(40)[[0, 1]], "all look in nearly the same direction"),
        (rolled(ring_cameras(6), [0, 60, -40, 20, 90, -70]), "were not held level"),
    ],
)
def test_cameras_that_do_not_tell(cameras: Cameras, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        up_of_cameras(cameras)


def test_who_says_which_way_is_up() -> None:
    scene = Scene("plant", (View("0", Path("0.png")), View("1", Path("1.png"))), ring_cameras(4)[[0, 1]])
    assert find_up(scene, None).up is None
    known = replace(scene, up=(0.0, 3.0, 0.0))
    assert known.up == (0, 1, 0)
    assert find_up(known, None).up == (0, 1, 0)
    assert find_up(known, (0.0, 0.0, -5.0)).up == (0, 0, -1)
    assert find_up(known, "rig").up == pytest.approx((0, 0, 1))
    with pytest.raises(InputError, match="up is"):
        replace(scene, up=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.48, 0.64)])
def test_frames_are_right_handed(up: tuple[float, float, float]) -> None:
    frame = level_frame(up)
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
    assert frame[2] == pytest.approx(up)
