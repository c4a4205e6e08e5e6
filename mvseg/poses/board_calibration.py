"""A turntable calibrated once: one camera that stands still, and photos of a board on the table at several angles.

The unknowns are the camera (OpenCV's calibration starts it), its pose, the board's pose on the table and the angle of
each photo. All are refined together, so that all photos are turns about one axis; the reprojection error is least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError
from mvseg.formats.board import BoardConfig
from mvseg.formats.markers import Grey, find_board

Floats = NDArray[np.float64]

LEAST_PHOTOS = 4
LEAST_CORNERS = 6  # of a photo
LEAST_TURN = 10.0  # degrees, of all photos together
HALF = 0.5  # OpenCV's pixels start at -0.5
FLAT = 0.7  # cosine between the axis and the normal of a board that lies, more or less, flat
MOST_RESIDUAL = 0.005  # in widths of the photo, above which the table did not only turn


@dataclass(frozen=True, eq=False)
class TurntableCalibration:
    """One camera beside a turntable; the world stands on the table, its z axis is that of the table, upwards.

    Attributes:
        K: (3, 3) float64, pixel centres at half integers.
        distortion: (5,) k1, k2, p1, p2, k3.
        R: (3, 3) float64 of cam_from_world at angle 0.
        t: (3,) float64 of cam_from_world at angle 0, in the unit of the board.
        size: width and height of the photos.
        angles: (V,) degrees by which the table has turned, as turntable files count; NaN where no board is seen.
        residual_px: root mean square reprojection error of the corners.
        num_corners: of the board, in all photos.
    """

    K: Floats
    distortion: Floats
    R: Floats
    t: Floats
    size: tuple[int, int]
    angles: Floats
    residual_px: float
    num_corners: int


def calibrate_turntable(photos: Sequence[Grey], board: BoardConfig) -> TurntableCalibration:
    """Camera, axis and angles from V photos of a board that turns with the table.

    Angle 0 is that of the first photo that shows the board. The world's origin is on the axis, at the height of the
    middle of the board.

    Args:
        photos: V of (H, W) uint8, of one size, with lens distortion.
        board: printed; it may lie or stand on the table, tilted or not.

    Raises:
        InputError: photos of different sizes, too few that show the board, a table that hardly turned, or photos that
            no turn about one axis explains.
    """
    size = (photos[0].shape[1], photos[0].shape[0])
    for index, photo in enumerate(photos):
        if photo.shape[::-1] != size:
            other = f"{photo.shape[1]} x {photo.shape[0]}"
            raise InputError(f"photo {index} has {other} pixels, the first {size[0]} x {size[1]}, expected one camera")
    seen = [find_board(photo, board) for photo in photos]
    used = [index for index, (numbers, _) in enumerate(seen) if len(numbers) >= LEAST_CORNERS]
    if len(used) < LEAST_PHOTOS:
        message = f"{len(used)} of {len(photos)} photos show {LEAST_CORNERS} corners of the board or more"
        raise InputError(f"{message}, expected at least {LEAST_PHOTOS}: is it {board.columns} x {board.rows}?")
    corners = [board.corners()[seen[index][0]] for index in used]
    px = [seen[index][1] for index in used]
    K, distortion, poses = _calibrate_camera(corners, px, size)
    start = _start_axis(poses)
    if np.ptp(start[2]) < LEAST_TURN:
        raise InputError(f"the board turned by {np.ptp(start[2]):.1f} degrees in all, expected a table that turns")
    K, distortion, (R, t), angles, residuals = _refine(K, distortion, start, corners=corners, px=px)
    residual = float(np.sqrt((residuals**2).sum(1).mean()))
    if residual > MOST_RESIDUAL * size[0]:
        message = f"one turning axis explains the board to {residual:.1f} px only"
        raise InputError(f"{message}: did the camera move, or the board on the table?")
    all_angles = np.full(len(photos), np.nan)
    all_angles[used] = angles
    return TurntableCalibration(
        K=K,
        distortion=distortion,
        R=R,
        t=t,
        size=size,
        angles=all_angles,
        residual_px=residual,
        num_corners=sum(map(len, px)),
    )


def _calibrate_camera(
    corners: list[Floats], px: list[Floats], size: tuple[int, int]
) -> tuple[Floats, Floats, list[tuple[Floats, Floats]]]:
    """OpenCV's calibration: K, distortion, and (R, t) of cam_from_board of each photo."""
    world = [each.astype(np.float32)[:, None] for each in corners]
    image = [(each - HALF).astype(np.float32)[:, None] for each in px]
    guess = np.array([[1.2 * max(size), 0, size[0] / 2], [0, 1.2 * max(size), size[1] / 2], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, K, distortion, turns, shifts = cv2.calibrateCamera(world, image, size, guess, None, flags=flags)
    found = zip(turns, shifts, strict=True)
    poses = [(np.array(cv2.Rodrigues(turn)[0], float), np.array(shift, float).ravel()) for turn, shift in found]
    return np.asarray(K, float), np.asarray(distortion, float).ravel()[:5], poses


def _start_axis(poses: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats, Floats, Rotation, Floats]:
    """A first axis from the boards' poses, all in the camera's frame.

    Returns:
        Direction and point of the axis, the angles (V,) in degrees from the first photo; and the first board's pose.
    """
    first = Rotation.from_matrix(poses[0][0])
    turns = [Rotation.from_matrix(R) * first.inv() for R, _ in poses]
    vectors = np.array([turn.as_rotvec() for turn in turns])
    _, _, axes = np.linalg.svd(vectors)
    direction = axes[0]
    # Along the axis, the positions of any point of the board do not change: these turns by more than half a circle too.
    angles = np.degrees(vectors @ direction)
    # The point: c with R_i c + (t_i - R_i t_0) = c for the motion of every photo against the first.
    rows = np.concatenate([turn.as_matrix() - np.eye(3) for turn in turns] + [direction[None]])
    shifts = [turn.apply(poses[0][1]) - t for turn, (_, t) in zip(turns, poses, strict=True)]
    right = np.concatenate([*shifts, np.zeros(1)])
    point = np.linalg.lstsq(rows, right, rcond=None)[0]
    return direction, point, angles, first, poses[0][1]


def _refine(
    K: Floats,
    distortion: Floats,
    start: tuple[Floats, Floats, Floats, Rotation, Floats],
    *,
    corners: list[Floats],
    px: list[Floats],
) -> tuple[Floats, Floats, tuple[Floats, Floats], Floats, Floats]:
    """Least squares over everything, in the frame of the table: z along the axis, the board's middle at height 0.

    Returns:
        K (pixel centres at half integers), distortion, (R, t) of cam_from_world, angles in degrees, residuals (P, 2).
    """
    direction, point, angles, board_turn, board_shift = start
    middle = np.concatenate(corners).mean(0)
    board_middle = board_turn.apply(middle) + board_shift
    normal = board_turn.as_matrix()[:, 2]
    upwards = normal if abs(normal @ direction) > FLAT else np.array([0.0, -1, 0])  # of a standing board: the camera's
    if upwards @ direction < 0:
        direction, angles = -direction, -angles
    point = point + ((board_middle - point) @ direction) * direction
    side = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    cam_from_world = Rotation.from_matrix(np.column_stack([side, np.cross(direction, side), direction]))
    world_from_board = cam_from_world.inv() * board_turn
    shift = cam_from_world.inv().apply(board_shift - point)
    fixed = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion[:4]])
    # The turn of the board about z and its height stay as they are: angle 0 and the origin are defined by them.
    x0 = np.concatenate([
        fixed, cam_from_world.as_rotvec(), point, world_from_board.as_rotvec(), shift[:2], np.radians(angles[1:])
    ])  # fmt: skip
    count = np.array([len(each) for each in corners])
    photo = np.repeat(np.arange(len(corners)), count)
    world, observed = np.concatenate(corners), np.concatenate(px) - HALF

    def project(x: Floats) -> Floats:
        board = Rotation.from_rotvec(x[14:17]).apply(world) + [*x[17:19], shift[2]]
        turned = Rotation.from_rotvec(np.append(0.0, x[19:])[photo][:, None] * [0, 0, 1.0]).apply(board)
        cam = Rotation.from_rotvec(x[8:11]).apply(turned) + x[11:14]
        return _project_opencv(cam, x[:8]) - observed

    scales = np.maximum(np.abs(x0), 1e-2)
    fit = least_squares(lambda x: project(x).ravel(), x0, x_scale=scales, max_nfev=200)
    x = fit.x
    K = np.array([[x[0], 0, x[2] + HALF], [0, x[1], x[3] + HALF], [0, 0, 1]])
    R = Rotation.from_rotvec(x[8:11]).as_matrix()
    return K, np.append(x[4:8], 0.0), (R, x[11:14]), np.degrees(np.append(0.0, x[19:])), project(x)


def _project_opencv(cam: Floats, lens: Floats) -> Floats:
    """(P, 2) OpenCV pixels of points (P, 3) in the camera's frame; lens holds fx, fy, cx, cy, k1, k2, p1, p2."""
    x, y = (cam[:, :2] / cam[:, 2:]).T
    r2 = x**2 + y**2
    k1, k2, p1, p2 = lens[4:]
    radial = 1 + k1 * r2 + k2 * r2**2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([lens[0] * u + lens[2], lens[1] * v + lens[3]], 1)
