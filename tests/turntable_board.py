"""Photos of a board that turns on a table in front of a known camera: exact, by warping one plane."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from room_scene import BOARD, PX_PER_MM, board_picture, texture

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0
K = np.array([[FOCAL, 0, 325.0], [0, FOCAL, 236.0], [0, 0, 1]])
ANGLES = np.array([0.0, 35, 70, 110, 150, 200, 250, 300])
ELEVATION, DISTANCE = np.radians(50), 420.0
# The camera looks at the origin of the table from above; z is the axis, upwards.
R = np.array([
    [1.0, 0, 0],
    [0, -np.sin(ELEVATION), -np.cos(ELEVATION)],
    [0, np.cos(ELEVATION), -np.sin(ELEVATION)],
])  # fmt: skip
T = np.array([0.0, 0, DISTANCE])
# The board lies off the axis, tilted by some degrees.
BOARD_TURN = Rotation.from_euler("xyz", [6, -4, 20], degrees=True)


def board_shift(tilt: Rotation) -> np.ndarray:
    """(3,) where the board's corner is on the table, so that its middle is nearly on the axis."""
    return tilt.apply([-90.0, -70, 0]) + [12, -7, 0]


# A second camera, lower and on another side.
SIDE_R = R @ Rotation.from_euler("z", 50, degrees=True).as_matrix()
SIDE_R = Rotation.from_euler("x", 12, degrees=True).as_matrix() @ SIDE_R
SIDE_T = np.array([6.0, -4, 450])


def draw_board(
    angle: float,
    *,
    shift: tuple[float, float, float] = (0, 0, 0),
    pose: tuple[np.ndarray, np.ndarray] = (R, T),
    tilt: Rotation = BOARD_TURN,
    has_texture: bool = False,
) -> np.ndarray:
    """(H, W) uint8: the board after the table has turned by `angle` degrees; `shift` of the table, mm; `tilt` turns
    the board on it.

    Seen by a camera whose cam_from_world is `pose` at angle 0. With texture, a poster lies in place of the board.
    """
    R, T = pose
    picture = board_picture(BOARD)
    if has_texture:
        picture = np.ascontiguousarray(texture(7)[: picture.shape[0], : picture.shape[1], 0])
    picture = cv2.copyMakeBorder(picture, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    board_from_picture = np.diag([1 / PX_PER_MM, -1 / PX_PER_MM, 1.0])
    board_from_picture[:2, 2] = [-10, BOARD.rows * BOARD.square + 10]
    turn = Rotation.from_euler("z", angle, degrees=True)
    axes = (turn * tilt).as_matrix()
    plane = np.column_stack([R @ axes[:, :2], R @ (turn.apply(board_shift(tilt)) + shift) + T])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    larger = half @ np.diag([3.0, 3, 1]) @ K @ plane @ board_from_picture @ np.linalg.inv(half)
    photo = cv2.warpPerspective(picture, larger, (3 * WIDTH, 3 * HEIGHT), flags=cv2.INTER_LINEAR, borderValue=90)
    return np.asarray(cv2.resize(photo, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)
