"""A rendered board that turns in front of a known camera: K, axis and angles come back."""

from __future__ import annotations

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.poses.board_calibration import calibrate_turntable
from room_scene import BOARD
from turntable_board import ANGLES, HEIGHT, WIDTH, K, R, T, draw_board


def test_camera_axis_and_angles_come_back() -> None:
    photos = [draw_board(angle) for angle in ANGLES]
    photos.insert(3, np.full((HEIGHT, WIDTH), 90, np.uint8))  # one without the board
    found = calibrate_turntable(photos, BOARD)
    assert np.isnan(found.angles[3])
    turned = np.delete(found.angles, 3) % 360
    np.testing.assert_allclose((turned - ANGLES + 180) % 360 - 180, 0, atol=0.2)  # degrees
    np.testing.assert_allclose(found.K, K, atol=6)
    assert found.residual_px < 0.3
    # Where the camera stands from the axis: its distance, its height and the direction in which it looks.
    center, true_center = -found.R.T @ found.t, -R.T @ T
    assert np.hypot(*center[:2]) == pytest.approx(np.hypot(*true_center[:2]), rel=0.01)
    assert found.R[:, 2] @ R[:, 2] == pytest.approx(1, abs=1e-4)  # the axis in the camera's frame
    # The origin is on the axis: both cameras see the same line there, whatever its height.
    on_axis = found.t + found.R[:, 2] * ((T - found.t) @ found.R[:, 2])
    np.testing.assert_allclose(on_axis, T, atol=5)


def test_points_on_the_table_are_seen_where_they_are() -> None:
    """Corners of the board at an angle that was left out, in the world of the calibration."""
    found = calibrate_turntable([draw_board(angle) for angle in ANGLES[:-1]], BOARD)
    both = calibrate_turntable([draw_board(angle) for angle in ANGLES], BOARD)
    assert both.angles[-1] % 360 == pytest.approx(300, abs=0.2)
    np.testing.assert_allclose(found.angles, both.angles[:-1], atol=0.2)
    np.testing.assert_allclose(found.K, both.K, atol=4)


def test_what_is_no_turntable() -> None:
    still = [draw_board(0.0)] * 5
    with pytest.raises(InputError, match=r"turned by 0.0 degrees"):
        calibrate_turntable(still, BOARD)
    moved = [draw_board(angle, shift=(3 * angle % 70, 0, angle % 40)) for angle in ANGLES]
    with pytest.raises(InputError, match=r"one turning axis explains the board to .* px only"):
        calibrate_turntable(moved, BOARD)
    with pytest.raises(InputError, match=r"^3 of 5 photos show 6 corners"):
        calibrate_turntable([*still[:3], *[np.full((HEIGHT, WIDTH), 90, np.uint8)] * 2], BOARD)
    with pytest.raises(InputError, match=r"photo 1 has 480 x 640 pixels, the first 640 x 480"):
        calibrate_turntable([still[0], still[0].T], BOARD)
