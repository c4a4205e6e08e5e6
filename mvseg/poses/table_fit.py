"""Fits fixed cameras beside a turntable to their sightings of a board on it.

The world is fixed to the table and turns with it; its z axis is that of the table, upwards. Unknown are the cameras,
the board's pose on the table and the angles. All cameras share axis and angles, and every photo is a turn about that
axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HALF = 0.5  # OpenCV's pixels start at -0.5
NUM_CAMERA = 14  # numbers of a camera: fx, fy, cx, cy, k1, k2, p1, p2, and its pose


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


@dataclass(frozen=True, eq=False)
class Sightings:
    """P corners of the board in photos.

    Attributes:
        camera: (P,) int64, which camera saw it.
        angle: (P,) int64, at which of the angles.
        point: (P, 3) float64, in the board's frame.
        px: (P, 2) float64, with lens distortion, pixel centres at half integers.
    """

    camera: Ints
    angle: Ints
    point: Floats
    px: Floats


def fit_table(
    cameras: Sequence[TableCamera], angles: Floats, world_from_board: pycolmap.Rigid3d, *, sightings: Sightings
) -> tuple[list[TableCamera], Floats, Floats]:
    """Least squares over cameras (but for k3), poses and angles.

    Args:
        cameras: C, initial values, nearly right.
        angles: (A,) degrees, initial values; the first stays as it is.
        world_from_board: initial value. Its height is fixed: it and the first angle define the world.
        sightings: of the board, with every camera and every angle in it.

    Returns:
        The C cameras, (A,) angles in degrees, and reprojection errors (P, 2) in pixels.
    """
    turn, shift = Rotation.from_matrix(world_from_board.rotation.matrix()), world_from_board.translation
    # The cameras one after another, the pose of the board without its height, and all angles but the first.
    start = np.concatenate([*map(_camera_numbers, cameras), turn.as_rotvec(), shift[:2], np.radians(angles[1:])])

    def split(numbers: Floats) -> tuple[Floats, Floats, Floats]:
        of_cameras, rest = np.split(numbers, [NUM_CAMERA * len(cameras)])
        pose = np.append(rest[:5], shift[2])
        return of_cameras.reshape(-1, NUM_CAMERA), pose, np.append(np.radians(angles[0]), rest[5:])

    fit = least_squares(
        lambda numbers: _residuals(*split(numbers), sightings).ravel(),
        start,
        x_scale=np.maximum(np.abs(start), 1e-2),
        max_nfev=200,
    )
    found, pose, turned = split(fit.x)
    fitted = [_with_numbers(camera, each) for camera, each in zip(cameras, found, strict=True)]
    return fitted, np.degrees(turned), _residuals(found, pose, turned, sightings)


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


def _residuals(cameras: Floats, pose: Floats, angles: Floats, sightings: Sightings) -> Floats:
    """(P, 2) reprojection errors, pixels; cameras (C, 14), world_from_board (6,) and angles (A,) in radians."""
    shape = Rotation.from_rotvec(pose[:3]).apply(sightings.point) + pose[3:]
    turned = Rotation.from_rotvec(angles[sightings.angle][:, None] * [0, 0, 1.0]).apply(shape)
    residuals = np.zeros_like(sightings.px)
    for index, camera in enumerate(cameras):
        here = sightings.camera == index
        fx, fy, cx, cy = camera[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        px, _ = cv2.projectPoints(turned[here], camera[8:11], camera[11:14], K, camera[4:8])
        residuals[here] = px[:, 0] - (sightings.px[here] - HALF)
    return residuals
