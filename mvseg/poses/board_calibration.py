"""Calibrates a turntable once: fixed cameras, and photos of a board on the table at several angles.

The unknowns are the cameras, their poses, the board's pose on the table and the angles. All are found together for the
least reprojection error (see `table_fit.py`), with all photos being rotations about one axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from mvseg.arrays import Floats
from mvseg.errors import InputError
from mvseg.formats.board import BoardConfig
from mvseg.formats.markers import Grey, find_board
from mvseg.poses.numbers import TABLE
from mvseg.poses.table_fit import TableCamera, TableFit, fit_table, opencv_matrix

Seen = dict[int, tuple[np.ndarray, Floats]]  # {place of the angle: numbers and pixels of the corners}
Poses = dict[int, pycolmap.Rigid3d]  # {place of the angle: cam_from_board}


@dataclass(frozen=True, eq=False)
class TurntableCalibration:
    """Cameras beside a turntable; the world stands on the table, its z axis is that of the table, upwards.

    Attributes:
        cameras: by name; their lengths are in the unit of the board.
        angles: (A,) degrees by which the table has turned, as turntable files count; NaN where none sees the board.
        residual_px: root mean square reprojection error of the corners.
        num_corners: number of corners of the board, in all photos together.
    """

    cameras: dict[str, TableCamera]
    angles: Floats
    residual_px: float
    num_corners: int


def calibrate_turntable(
    photos: Mapping[str, Sequence[Grey]], board: BoardConfig, *, lens: TableCamera | None = None
) -> TurntableCalibration:
    """Cameras, axis and angles from photos of a board that turns with the table. Angle 0 is the first at which a camera
    sees the board. The world's origin is on the axis, at the height of the middle of the board.

    Args:
        photos: A photos of each camera, at the same angles in the same order: (H, W) uint8, of one size for each
            camera, with lens distortion.
        board: printed; it may lie or stand on the table. Tilted by 10 to 30 degrees it shows the focal length best.
        lens: K, distortion and size of every camera, which then stay as they are (its pose has no meaning); None: they
            are found, with square pixels.

    Raises:
        InputError: photos of one camera of different sizes, another number of photos than of the other cameras, too few
            that show the board, a table that hardly turned, a camera that sees the board at no angle at which others
            do, or photos that no rotation about one axis explains.
    """
    num_angles = len(next(iter(photos.values())))
    boards = {}
    for name, each in photos.items():
        where = f"camera {name}: " if len(photos) > 1 else ""
        if len(each) != num_angles:
            message = f"{len(each)} photos, {num_angles} of camera {next(iter(photos))}"
            raise InputError(f"{where}{message}, expected as many, at the same angles in the same order")
        boards[name] = _find_boards(each, board, where)
    is_given = lens is not None
    starts = [dict.fromkeys(photos, lens)] if lens else [_middling_lenses(photos, focal) for focal in TABLE.starts]
    start_fit = partial(_fit, boards, board, noise_px=TABLE.noise_px, fix_lenses=is_given, tolerance=TABLE.rough)
    fits = [start_fit(start)[1] for start in starts]
    rough = min(fits, key=lambda fit: fit.cost)  # from a wrong focal length, side minima are possible
    if rough.residual_px > TABLE.most_residual * max(each.size[0] for each in rough.cameras):
        message = f"one axis of rotation explains the board to {rough.residual_px:.1f} px only"
        raise InputError(f"{message}: did a camera move, or the board on the table?")
    lenses = dict(zip(photos, rough.cameras, strict=True))
    noise_px = max(TABLE.least_noise_px, float(np.sqrt((rough.residuals**2).mean())))
    used, fit = _fit(boards, board, lenses, noise_px=noise_px, fix_lenses=is_given, tolerance=TABLE.fine)
    angles = np.full(num_angles, np.nan)
    angles[used] = fit.angles
    cameras, residual_px = dict(zip(photos, fit.cameras, strict=True)), fit.residual_px
    return TurntableCalibration(cameras, angles, residual_px=residual_px, num_corners=len(fit.residuals))


def _find_boards(photos: Sequence[Grey], board: BoardConfig, where: str) -> Seen:
    """{index of a photo: numbers and pixels of the corners}, of photos that show enough of them."""
    size = photos[0].shape[::-1]
    for index, photo in enumerate(photos):
        if photo.shape[::-1] != size:
            given = f"{photo.shape[1]} x {photo.shape[0]} pixels, the first {size[0]} x {size[1]}"
            raise InputError(f"{where}photo {index} has {given}, expected one camera")
    seen = {index: find_board(photo, board) for index, photo in enumerate(photos)}
    boards = {index: each for index, each in seen.items() if len(each[0]) >= TABLE.least_corners}
    if len(boards) < TABLE.least_photos:
        shown = f"{len(boards)} of {len(photos)} photos show {TABLE.least_corners} corners of the board or more"
        squares = f"{board.columns} x {board.rows}"
        raise InputError(f"{where}{shown}, expected at least {TABLE.least_photos}: is it {squares}?")
    return boards


def _middling_lenses(photos: Mapping[str, Sequence[Grey]], focal: float) -> dict[str, TableCamera]:
    """Pinholes with this focal length, in longer sides of the photos, in cameras without poses."""
    lenses = {}
    for name, each in photos.items():
        height, width = each[0].shape
        f = focal * max(height, width)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        lenses[name] = TableCamera(K=K, distortion=np.zeros(5), R=np.eye(3), t=np.zeros(3), size=(width, height))
    return lenses


def _fit(
    sightings: Mapping[str, Seen],
    board: BoardConfig,
    lenses: Mapping[str, TableCamera],
    *,
    noise_px: float,
    fix_lenses: bool,
    tolerance: float,
) -> tuple[list[int], TableFit]:
    """Places of the angles at which the board is seen, and the fit that explains it best; `lenses` are nearly right."""
    poses = {name: {angle: _board_pose(*each, board, lenses[name]) for angle, each in corners_of.items()}
             for name, corners_of in sightings.items()}  # fmt: skip
    numbers = [each for photos in sightings.values() for each, _ in photos.values()]
    corners = np.concatenate([board.corners()[each] for each in numbers])
    cameras, angles, world_from_board = _initialise(lenses, poses, middle=corners.mean(0))
    used = sorted(angles)
    rows = [
        (np.full(len(px), index), np.full(len(px), used.index(angle)), board.corners()[numbers], px)
        for index, corners_of in enumerate(sightings.values())
        for angle, (numbers, px) in corners_of.items()
    ]
    camera, angle, point, px = (np.concatenate(column) for column in zip(*rows, strict=True))
    start = [cameras[name] for name in sightings], np.array([angles[each] for each in used]), world_from_board
    seen = (camera, angle, point, px)
    return used, fit_table(*start, sightings=seen, noise_px=noise_px, fix_lenses=fix_lenses, tolerance=tolerance)


def _board_pose(numbers: np.ndarray, px: Floats, board: BoardConfig, lens: TableCamera) -> pycolmap.Rigid3d:
    _, turn, shift = cv2.solvePnP(board.corners()[numbers], px - 0.5, opencv_matrix(lens.K), lens.distortion)
    return _rigid(Rotation.from_rotvec(np.ravel(turn)), np.ravel(shift))


def _initialise(
    lenses: Mapping[str, TableCamera], poses: Mapping[str, Poses], *, middle: Floats
) -> tuple[dict[str, TableCamera], dict[int, float], pycolmap.Rigid3d]:
    """Cameras in one world, {place of the angle: degrees} and world_from_board, from the poses of the boards alone."""
    first = max(poses, key=lambda name: len(poses[name]))
    cam_from_world, angles, world_from_board = _initial_world(poses[first], middle)
    placed = {first: cam_from_world}
    while len(placed) < len(poses):
        name = max(poses.keys() - placed.keys(), key=lambda name: (len(poses[name].keys() & angles.keys()), name))
        common = sorted(poses[name].keys() & angles.keys())
        if not common:
            raise InputError(f"camera {name}: it sees the board at no angle at which another camera does")
        placed[name] = poses[name][common[0]] * (_turn_z(angles[common[0]]) * world_from_board).inverse()
        for place, pose in poses[name].items():
            turned = placed[name].inverse() * pose * world_from_board.inverse()
            angles.setdefault(place, float(np.degrees(_rotation(turned).as_rotvec()[2])))
    zero = angles[min(angles)]
    poses_of = [(name, lens, placed[name] * _turn_z(zero)) for name, lens in lenses.items()]
    cameras = {name: replace(lens, R=pose.rotation.matrix(), t=pose.translation) for name, lens, pose in poses_of}
    return cameras, {place: angle - zero for place, angle in angles.items()}, world_from_board


def _initial_world(poses: Poses, middle: Floats) -> tuple[pycolmap.Rigid3d, dict[int, float], pycolmap.Rigid3d]:
    """cam_from_world, angles (degrees, 0 first) and world_from_board; z is the axis, 0 at the board's middle (3,)."""
    direction, point, turns = _find_axis(list(poses.values()))
    if np.ptp(turns) < TABLE.least_turn:
        raise InputError(f"the board turned by {np.ptp(turns):.1f} degrees in all, expected a table that turns")
    cam_from_board = next(iter(poses.values()))
    normal = cam_from_board.rotation.matrix()[:, 2]
    is_flat = abs(normal @ direction) > TABLE.flat
    upwards = normal if is_flat else np.array([0.0, -1, 0])  # of a standing board: the camera's
    if upwards @ direction < 0:
        direction, turns = -direction, -turns
    point = point + ((cam_from_board * middle - point) @ direction) * direction
    side = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    axes = np.column_stack([side, np.cross(direction, side), direction])
    cam_from_world = _rigid(Rotation.from_matrix(axes), point)
    return cam_from_world, dict(zip(poses, turns.tolist(), strict=True)), cam_from_world.inverse() * cam_from_board


def _find_axis(poses: Sequence[pycolmap.Rigid3d]) -> tuple[Floats, Floats, Floats]:
    """Direction (3,) and point (3,) of the axis, and angles (A,) in degrees from the first of A poses of the board."""
    motions = [pose * poses[0].inverse() for pose in poses]
    vectors = np.array([_rotation(motion).as_rotvec() for motion in motions])
    direction = np.linalg.svd(vectors)[2][0]
    angles = np.degrees(vectors @ direction)
    # The point that no motion moves, and that has no component along the axis.
    rows = np.concatenate([*(motion.rotation.matrix() - np.eye(3) for motion in motions), direction[None]])
    shifts = np.concatenate([*(-motion.translation for motion in motions), np.zeros(1)])
    return direction, np.linalg.lstsq(rows, shifts, rcond=None)[0], angles


def _turn_z(angle_deg: float) -> pycolmap.Rigid3d:
    return _rigid(Rotation.from_euler("z", angle_deg, degrees=True), np.zeros(3))


def _rigid(turn: Rotation, shift: Floats) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_matrix()), shift)


def _rotation(rigid: pycolmap.Rigid3d) -> Rotation:
    return Rotation.from_matrix(rigid.rotation.matrix())
