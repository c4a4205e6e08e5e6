"""Fits fixed cameras beside a turntable to their sightings of a known shape on it.

The world is fixed to the table and turns with it; its z axis is that of the table, upwards. Unknown are the cameras,
the shape's pose on the table and the angles. All cameras share axis and angles, and every photo is a turn about that
axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HALF = 0.5  # OpenCV's pixels start at -0.5
NUM_LENS, NUM_CAMERA = 8, 14  # numbers of a camera: fx, fy, cx, cy, k1, k2, p1, p2, and with its pose


@dataclass(frozen=True, eq=False)
class TableCamera:
    """A camera beside a turntable.

    Attributes:
        K: (3, 3) float64, pixel centres at half integers.
        distortion: (5,) k1, k2, p1, p2, k3.
        R: (3, 3) float64 of cam_from_world at angle 0.
        t: (3,) float64 of cam_from_world at angle 0, in the unit of the scene.
        size: width and height of the photos.
    """

    K: Floats
    distortion: Floats
    R: Floats
    t: Floats
    size: tuple[int, int]

    def pose(self, angle_deg: float) -> tuple[Floats, Floats]:
        """R (3, 3) and t (3,) of cam_from_world when the table has turned by an angle."""
        return self.R @ turn_z(angle_deg).as_matrix(), self.t


@dataclass(frozen=True, eq=False)
class Sightings:
    """P points of the shape in photos.

    Attributes:
        camera: (P,) int64, which camera saw it.
        angle: (P,) int64, at which of the angles.
        point: (P, 3) float64, in the shape's own world.
        px: (P, 2) float64, with lens distortion, pixel centres at half integers.
    """

    camera: Ints
    angle: Ints
    point: Floats
    px: Floats


@dataclass(frozen=True, eq=False)
class TableFit:
    """What fits the sightings best: C cameras, (A,) angles in degrees, and residuals (P, 2) in pixels."""

    cameras: list[TableCamera]
    angles: Floats
    residuals: Floats


def fit_table(
    cameras: Sequence[TableCamera],
    angles: Floats,
    shape_pose: tuple[Rotation, Floats],
    *,
    sightings: Sightings,
    fixed_angle: int,
    has_free_lenses: bool,
) -> TableFit:
    """Least squares over poses and angles, and over lenses if these are free (k3 never is).

    Args:
        cameras: C, initial values, nearly right.
        angles: (A,) degrees, initial values.
        shape_pose: world_from_shape, initial value. Its height is fixed: it and the fixed angle define the world.
        sightings: of the shape, with every camera and every angle in it.
        fixed_angle: which angle stays as it is.
        has_free_lenses: false: lenses are fixed, and outliers are weighted down (soft L1, 1 pixel).
    """
    turn, shift = shape_pose
    # The cameras one after another, the pose of the shape without its height, and all angles.
    start = np.concatenate([*map(_camera_numbers, cameras), turn.as_rotvec(), shift[:2], np.radians(angles)])
    is_free = np.ones(len(start), bool)
    is_free[NUM_CAMERA * len(cameras) + 5 + fixed_angle] = False
    if not has_free_lenses:
        is_free[: NUM_CAMERA * len(cameras)] = np.tile(np.arange(NUM_CAMERA) >= NUM_LENS, len(cameras))

    def residuals(free: Floats) -> Floats:
        numbers = start.copy()
        numbers[is_free] = free
        return _residuals(numbers, sightings, num_cameras=len(cameras), height=shift[2])

    x0 = start[is_free]
    fit = least_squares(
        lambda free: residuals(free).ravel(),
        x0,
        x_scale=np.maximum(np.abs(x0), 1e-2),
        loss="linear" if has_free_lenses else "soft_l1",
        max_nfev=200,
    )
    found = start.copy()
    found[is_free] = fit.x
    fitted = [
        _with_numbers(camera, found[NUM_CAMERA * index : NUM_CAMERA * (index + 1)])
        for index, camera in enumerate(cameras)
    ]
    return TableFit(fitted, np.degrees(found[NUM_CAMERA * len(cameras) + 5 :]), residuals(fit.x))


def turn_z(angle_deg: float) -> Rotation:
    """The turn of the table."""
    return Rotation.from_euler("z", angle_deg, degrees=True)


def _camera_numbers(camera: TableCamera) -> Floats:
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2] - HALF, K[1, 2] - HALF, *camera.distortion[:4]]
    return np.concatenate([lens, Rotation.from_matrix(camera.R).as_rotvec(), camera.t])


def _with_numbers(camera: TableCamera, numbers: Floats) -> TableCamera:
    fx, fy, cx, cy = numbers[:4]
    return replace(
        camera,
        K=np.array([[fx, 0, cx + HALF], [0, fy, cy + HALF], [0, 0, 1]]),
        distortion=np.append(numbers[4:8], 0.0),
        R=Rotation.from_rotvec(numbers[8:11]).as_matrix(),
        t=numbers[11:14],
    )


def _residuals(numbers: Floats, sightings: Sightings, *, num_cameras: int, height: float) -> Floats:
    """(P, 2) reprojection errors, pixels."""
    cameras, rest = np.split(numbers, [NUM_CAMERA * num_cameras])
    shape = Rotation.from_rotvec(rest[:3]).apply(sightings.point) + [*rest[3:5], height]
    turned = Rotation.from_rotvec(rest[5:][sightings.angle][:, None] * [0, 0, 1.0]).apply(shape)
    residuals = np.zeros_like(sightings.px)
    for index, camera in enumerate(cameras.reshape(num_cameras, NUM_CAMERA)):
        here = sightings.camera == index
        fx, fy, cx, cy = camera[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        px, _ = cv2.projectPoints(turned[here], camera[8:11], camera[11:14], K, camera[4:8])
        residuals[here] = px[:, 0] - (sightings.px[here] - HALF)
    return residuals
