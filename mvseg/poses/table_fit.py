"""Fits fixed cameras beside a turntable to their sightings of a board on it.

The world is fixed to the table and turns with it; its z axis is that of the table, upwards. Unknown are the cameras,
the board's pose on the table and the angles. All cameras share axis and angles, and every photo is a turn about that
axis.

A flat board seen from one height shows the same few degrees of perspective in every photo: focal length, principal
point, distortion and height trade off, and no residual tells. Pixels are therefore square, and what lenses are like
(`USUAL`) counts as one more measurement each: it decides where the photos do not, it is outweighed where they do, and
what it leaves open is in the deviation of the focal length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mvseg.arrays import Floats, Ints
from mvseg.poses.numbers import TABLE

# How far lenses of phones, cameras and webcams are from a pinhole with its axis in the middle: standard deviations of
# the numbers of a lens but f. A flat board leaves mostly the principal point open: at twice that, f is half
# as sure; a third of the others changes its deviation by less than a twentieth.
USUAL = np.array([TABLE.off_middle, TABLE.off_middle, 0.3, 0.3, 0.001, 0.001])
NUM_LENS = 1 + len(USUAL)  # f in widths of the photo; cx and cy from its middle, in widths; k1, k2, p1, p2


@dataclass(frozen=True, eq=False)
class TableCamera:
    """A camera beside a turntable.

    Attributes:
        K: (3, 3) float64, pixel centres at half integers.
        distortion: (5,) k1, k2, p1, p2, k3.
        R, t: (3, 3) and (3,) float64 of cam_from_world at angle 0, t in the unit of the scene.
        size: width and height of the photos.
        focal_deviation: standard deviation of the focal length, pixels; None where the lens was given.
    """

    K: Floats
    distortion: Floats
    R: Floats
    t: Floats
    size: tuple[int, int]
    focal_deviation: float | None = None


# P corners of the board in photos: (P,) which camera saw it, (P,) at which of the angles, (P, 3) in the board's frame,
# and (P, 2) pixels with lens distortion, pixel centres at half integers.
Sightings = tuple[Ints, Ints, Floats, Floats]


@dataclass(frozen=True, eq=False)
class TableFit:
    """Parameters that explain the sightings best.

    Attributes:
        cameras: C, with the deviations of their focal lengths.
        angles: (A,) degrees.
        residuals: (P, 2) reprojection errors, pixels.
        cost: squared residuals over `noise_px`, and squared departures of the lenses from what is usual, added up.
    """

    cameras: list[TableCamera]
    angles: Floats
    residuals: Floats
    cost: float

    @property
    def residual_px(self) -> float:
        """Root mean square distance of the corners from where they should be."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


def fit_table(
    cameras: Sequence[TableCamera],
    angles: Floats,
    world_from_board: pycolmap.Rigid3d,
    *,
    sightings: Sightings,
    noise_px: float,
    fix_lenses: bool,
    tolerance: float,
) -> TableFit:
    """Least squares over cameras (but for k3), poses and angles.

    Args:
        cameras: C, initial values, nearly right.
        angles: (A,) degrees, initial values; the first stays as it is.
        world_from_board: initial value. Its height is fixed: it and the first angle define the world.
        sightings: of the board, with every camera and every angle in it.
        noise_px: standard deviation of each coordinate of a sighting, which weighs it against what is usual.
        fix_lenses: K and distortion of the cameras stay as they are.
        tolerance: relative change of the cost at which the search ends.
    """
    shift = world_from_board.translation
    num_lens = 0 if fix_lenses else NUM_LENS
    # The cameras one after another, the pose of the board without its height, and all angles but the first.
    of_cameras = np.stack([_camera_numbers(camera)[NUM_LENS - num_lens :] for camera in cameras])
    turn = Rotation.from_matrix(world_from_board.rotation.matrix()).as_rotvec()
    start = np.concatenate([of_cameras.ravel(), turn, shift[:2], np.radians(angles[1:])])

    def split(numbers: Floats) -> tuple[list[TableCamera], Floats, Floats]:
        each, rest = np.split(numbers, [of_cameras.size])
        adjusted = [_with_numbers(*pair) for pair in zip(cameras, each.reshape(of_cameras.shape), strict=True)]
        return adjusted, np.append(rest[:5], shift[2]), np.append(np.radians(angles[0]), rest[5:])

    def residuals(numbers: Floats) -> Floats:
        lenses = numbers[: of_cameras.size].reshape(of_cameras.shape)[:, 1:num_lens]
        return np.append(_project(*split(numbers), sightings) / noise_px, lenses / USUAL[: lenses.shape[1]])

    fit = least_squares(residuals, start, x_scale="jac", ftol=tolerance, max_nfev=200)
    adjusted, pose, turned = split(fit.x)
    if not fix_lenses:
        variances = np.diag(np.linalg.pinv(fit.jac.T @ fit.jac))[: of_cameras.size].reshape(of_cameras.shape)[:, 0]
        pairs = zip(adjusted, np.sqrt(variances.clip(min=0)).tolist(), strict=True)
        adjusted = [replace(camera, focal_deviation=max(camera.size) * deviation) for camera, deviation in pairs]
    errors = _project(adjusted, pose, turned, sightings)
    return TableFit(cameras=adjusted, angles=np.degrees(turned), residuals=errors, cost=2 * float(fit.cost))


def _camera_numbers(camera: TableCamera) -> Floats:
    (width, height), longer, K = camera.size, max(camera.size), camera.K
    lens = [K[0, 0] / longer, (K[0, 2] - width / 2) / longer, (K[1, 2] - height / 2) / longer, *camera.distortion[:4]]
    return np.concatenate([lens, Rotation.from_matrix(camera.R).as_rotvec(), camera.t])


def _with_numbers(camera: TableCamera, numbers: Floats) -> TableCamera:
    """The camera with other numbers, (13,), or (6,) of another pose alone; k3 and the shape of its pixels stay."""
    lens, pose = np.split(numbers, [len(numbers) - 6])
    moved = replace(camera, R=Rotation.from_rotvec(pose[:3]).as_matrix(), t=pose[3:])
    if not len(lens):
        return moved
    (width, height), longer = camera.size, max(camera.size)
    fx, cx, cy = longer * lens[:3] + [0, width / 2, height / 2]
    K = np.array([[fx, 0, cx], [0, fx * camera.K[1, 1] / camera.K[0, 0], cy], [0, 0, 1]])
    return replace(moved, K=K, distortion=np.append(lens[3:], camera.distortion[4]))


def _project(cameras: Sequence[TableCamera], pose: Floats, angles: Floats, sightings: Sightings) -> Floats:
    """(P, 2) reprojection errors, pixels; world_from_board (6,) and angles (A,) in radians."""
    seen_by, place, point, seen_px = sightings
    shape = Rotation.from_rotvec(pose[:3]).apply(point) + pose[3:]
    turned = Rotation.from_rotvec(angles[place][:, None] * [0, 0, 1.0]).apply(shape)
    errors = np.zeros_like(seen_px)
    for index, camera in enumerate(cameras):
        here = seen_by == index
        turn = Rotation.from_matrix(camera.R).as_rotvec()
        px, _ = cv2.projectPoints(turned[here], turn, camera.t, opencv_matrix(camera.K), camera.distortion)
        errors[here] = px[:, 0] - (seen_px[here] - 0.5)
    return errors


def opencv_matrix(K: Floats) -> Floats:
    """K for OpenCV, whose first pixel has its centre at (0, 0)."""
    return K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
