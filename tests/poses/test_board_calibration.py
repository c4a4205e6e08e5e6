"""A rendered board that turns in front of a known camera: K, axis and angles come back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError
from mvseg.formats.markers import find_board
from mvseg.poses import board_calibration
from mvseg.poses.board_calibration import calibrate_turntable
from mvseg.poses.table_fit import TableCamera, opencv_matrix
from room_scene import BOARD
from turntable_board import ANGLES, HEIGHT, SIDE_R, SIDE_T, WIDTH, K, R, T, draw_board

NOTHING = np.full((HEIGHT, WIDTH), 90, np.uint8)  # a photo without the board


@pytest.fixture(scope="module")
def top() -> list[np.ndarray]:
    return [draw_board(angle) for angle in ANGLES]


@pytest.fixture(scope="module", autouse=True)
def once(top: list[np.ndarray]) -> Iterator[None]:
    """The board is looked for once in each of these photos."""
    seen = {id(photo): find_board(photo, BOARD) for photo in (*top, NOTHING)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            board_calibration,
            "find_board",
            lambda photo, board: seen[id(photo)] if id(photo) in seen else find_board(photo, board),
        )
        yield


def test_camera_axis_and_angles_come_back(top: list[np.ndarray]) -> None:
    found = calibrate_turntable({"camera": [*top[:3], NOTHING, *top[3:]]}, BOARD)
    camera = found.cameras["camera"]
    assert np.isnan(found.angles[3])
    turned = np.delete(found.angles, 3) % 360
    np.testing.assert_allclose((turned - ANGLES + 180) % 360 - 180, 0, atol=0.2)  # degrees
    np.testing.assert_allclose(camera.K, K, atol=6)
    assert found.residual_px < 0.3
    # Where the camera stands from the axis: its distance, its height and the direction in which it looks.
    center, true_center = -camera.R.T @ camera.t, -R.T @ T
    assert np.hypot(*center[:2]) == pytest.approx(np.hypot(*true_center[:2]), rel=0.01)
    assert camera.R[:, 2] @ R[:, 2] == pytest.approx(1, abs=1e-4)  # the axis in the camera's frame
    # The origin is on the axis: both cameras see the same line there, whatever its height.
    on_axis = camera.t + camera.R[:, 2] * ((T - camera.t) @ camera.R[:, 2])
    np.testing.assert_allclose(on_axis, T, atol=5)


def test_a_flat_board_from_one_height_gives_lengths_above_it() -> None:
    """Nothing but one flat board at one height: focal length, height and tilt trade off, and no residual shows it."""
    flat = Rotation.from_euler("z", 20, degrees=True)
    photos = [draw_board(angle, tilt=flat) for angle in ANGLES]
    found = calibrate_turntable({"camera": photos}, BOARD)
    camera = found.cameras["camera"]
    assert camera.focal_deviation is not None
    assert abs(camera.K[0, 0] - K[0, 0]) < 2 * camera.focal_deviation < 0.03 * K[0, 0]
    assert camera.K[0, 0] == camera.K[1, 1]
    assert height_above_table(camera, found.angles) == pytest.approx(100, abs=0.5)  # mm
    given = replace(camera, K=K, distortion=np.zeros(5))
    sure = calibrate_turntable({"camera": photos[:4]}, BOARD, lens=given)  # nothing is left to trade off
    np.testing.assert_array_equal(sure.cameras["camera"].K, K)
    assert height_above_table(sure.cameras["camera"], sure.angles) == pytest.approx(100, abs=1.0)


def height_above_table(camera: TableCamera, angles: np.ndarray) -> float:
    """How far apart two points on the table and 100 mm above it are, triangulated with a calibration, mm."""
    points = []
    for height in (0.0, 100.0):
        rays, turned = [], [Rotation.from_euler("z", angle, degrees=True) for angle in angles]
        for true_angle, turn in zip(ANGLES, turned, strict=False):
            place = Rotation.from_euler("z", true_angle, degrees=True).apply([20, 10, height])
            px = K @ (R @ place + T)
            x, y = cv2.undistortPoints(px[:2] / px[2] - 0.5, opencv_matrix(camera.K), camera.distortion).ravel()
            pose = np.column_stack([camera.R @ turn.as_matrix(), camera.t])
            rays += [x * pose[2] - pose[0], y * pose[2] - pose[1]]
        point = np.linalg.svd(np.array(rays))[2][-1]
        points.append(point[:3] / point[3])
    return float(np.linalg.norm(points[1] - points[0]))


def test_two_cameras_share_axis_and_angles(top: list[np.ndarray]) -> None:
    side = [draw_board(angle, pose=(SIDE_R, SIDE_T)) for angle in ANGLES]
    side[5] = side[6] = NOTHING
    found = calibrate_turntable({"top": [NOTHING, *top[1:]], "side": side}, BOARD)
    np.testing.assert_allclose((found.angles - ANGLES + 180) % 360 - 180, 0, atol=0.2)  # degrees
    assert found.angles[0] == 0
    assert found.residual_px < 0.3
    np.testing.assert_allclose(found.cameras["side"].K, K, atol=6)
    # The one as the other sees it.
    true_turn, true_shift = SIDE_R @ R.T, SIDE_T - SIDE_R @ R.T @ T
    top_camera, side_camera = (found.cameras[name] for name in ("top", "side"))
    turn = side_camera.R @ top_camera.R.T
    assert np.degrees(np.arccos(min(1, (np.trace(turn @ true_turn.T) - 1) / 2))) < 0.5
    np.testing.assert_allclose(side_camera.t - turn @ top_camera.t, true_shift, atol=5)


def test_cameras_that_do_not_belong_together(top: list[np.ndarray]) -> None:
    with pytest.raises(InputError, match=r"^camera side: 7 photos, 8 of camera top, expected as many"):
        calibrate_turntable({"top": top, "side": top[1:]}, BOARD)
    nothing = [NOTHING] * 4
    with pytest.raises(InputError, match=r"^camera side: it sees the board at no angle at which another camera does"):
        calibrate_turntable({"top": top[:4] + nothing, "side": nothing + top[4:]}, BOARD)
    with pytest.raises(InputError, match=r"^camera side: 1 of 8 photos show 6 corners"):
        calibrate_turntable({"top": top, "side": top[:1] + nothing + nothing[:3]}, BOARD)


def test_what_is_no_turntable(top: list[np.ndarray]) -> None:
    still = [top[0]] * 5
    with pytest.raises(InputError, match=r"turned by 0.0 degrees"):
        calibrate_turntable({"camera": still}, BOARD)
    moved = [draw_board(angle, shift=(3 * angle % 70, 0, angle % 40)) for angle in ANGLES[:5]]
    with pytest.raises(InputError, match=r"one axis of rotation explains the board to .* px only"):
        calibrate_turntable({"camera": moved}, BOARD)
    with pytest.raises(InputError, match=r"^3 of 5 photos show 6 corners"):
        calibrate_turntable({"camera": [*still[:3], NOTHING, NOTHING]}, BOARD)
    with pytest.raises(InputError, match=r"photo 1 has 480 x 640 pixels, the first 640 x 480"):
        calibrate_turntable({"camera": [still[0], still[0].T]}, BOARD)
