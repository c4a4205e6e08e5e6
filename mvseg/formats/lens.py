"""Lens distortion: removed from photos and masks once, on load, and put back when labels are written.

The undistorted image has the size and the K of the photo; only the distortion is removed. What the photo does not show
is black (nothing, in masks). Every camera model of COLMAP works, through pycolmap; a rig file's OpenCV coefficients are
COLMAP's FULL_OPENCV. Beyond some angle a lens polynomial is not monotonic, so that a photo pixel would appear twice,
and a fisheye sees more than a pinhole can: a position that does not return to itself under the mapping and its inverse
counts as not visible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np
import pycolmap

from mvseg.errors import InputError

CHUNK = 1 << 20  # limit: pixels at a time: all of a photo of 24 megapixels would take 3 GB

Mapping = Callable[[pycolmap.Camera, np.ndarray, np.ndarray], np.ndarray]


def opencv_lens(
    K: np.ndarray, distortion: Sequence[float], *, width: int, height: int, is_fisheye: bool = False
) -> pycolmap.Camera | None:
    """OpenCV's k1, k2, p1, p2 (, k3 (, k4, k5, k6)) as COLMAP's FULL_OPENCV, or k1 to k4 as its OPENCV_FISHEYE; K in
    this project's pixels. None for a pinhole. Raises InputError if K has skew together with distortion."""
    if not is_fisheye and not any(distortion):
        return None
    if K[0, 1] != 0:
        raise InputError("K has skew together with distortion, expected none")
    padding = [0.0] * ((4 if is_fisheye else 8) - len(distortion))
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion, *padding]
    model = "OPENCV_FISHEYE" if is_fisheye else "FULL_OPENCV"
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def opencv_distortion(lens: pycolmap.Camera | None) -> list[float] | None:
    """OpenCV's coefficients of a lens, as a rig file holds them: an empty list for a pinhole, None for a lens that
    OpenCV does not have."""
    if lens is None or lens.model_name in ("SIMPLE_PINHOLE", "PINHOLE"):
        return []
    numbers = [float(number) for number in lens.params]
    if lens.model_name in ("SIMPLE_RADIAL", "RADIAL"):
        return [*numbers[3:], 0.0, 0.0, 0.0, 0.0][:5]
    if lens.model_name not in ("OPENCV", "FULL_OPENCV"):
        return None
    return numbers[4:] if any(numbers[9:]) else numbers[4:9]


def photo_from_pinhole(lens: pycolmap.Camera, K: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Distort pixel positions: (P, 2) -> (P, 2) float64, pixel centres at half integers."""
    rays = np.linalg.solve(K, np.concatenate([xy, np.ones((len(xy), 1))], 1).T).T
    return np.asarray(lens.img_from_cam(rays))


def pinhole_from_photo(lens: pycolmap.Camera, K: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Undistort positions in the photo: (P, 2) -> (P, 2) float64; the inverse of the above."""
    rays = np.asarray(lens.cam_from_img(np.ascontiguousarray(xy, dtype=np.float64)))
    return rays @ K[:2, :2].T + K[:2, 2]


def undistort(image: np.ndarray, lens: pycolmap.Camera | None, K: np.ndarray) -> np.ndarray:
    """The photo or label map as the pinhole K sees it: same shape and dtype; labels (2-D) are never mixed."""
    return image if lens is None else _look_up(image, lens, K, mapping=photo_from_pinhole)


def distort(image: np.ndarray, lens: pycolmap.Camera | None, K: np.ndarray) -> np.ndarray:
    """The inverse of `undistort`: an undistorted image or label map as the photo's own lens sees it."""
    return image if lens is None else _look_up(image, lens, K, mapping=pinhole_from_photo)


def _look_up(image: np.ndarray, lens: pycolmap.Camera, K: np.ndarray, *, mapping: Mapping) -> np.ndarray:
    params, flat, size = tuple(lens.params), tuple(map(float, K.ravel())), (image.shape[1], image.shape[0])
    columns, rows = _positions(model=lens.model_name, params=params, K=flat, size=size, mapping=mapping)
    interpolation = cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_LINEAR
    return np.asarray(cv2.remap(image, columns, rows, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0))


@lru_cache(maxsize=2)  # one lens, both ways: a scene's photos and masks need the same positions again and again
def _positions(
    *, model: str, params: tuple[float, ...], K: tuple[float, ...], size: tuple[int, int], mapping: Mapping
) -> np.ndarray:
    """(2, H, W) float32 column and row to look up for each pixel, as cv2.remap counts; far outside for nothing."""
    width, height = size
    lens = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    matrix = np.array(K).reshape(3, 3)
    inverse = pinhole_from_photo if mapping is photo_from_pinhole else photo_from_pinhole
    positions = np.empty((2, height, width), np.float32)
    num_rows = max(1, CHUNK // width)
    for top in range(0, height, num_rows):
        rows, columns = np.mgrid[top : min(top + num_rows, height), :width] + 0.5
        centers = np.stack((columns.ravel(), rows.ravel()), 1)
        xy = mapping(lens, matrix, centers)
        returned = inverse(lens, matrix, np.where(np.isfinite(xy), xy, -1e6))
        is_shown = np.abs(returned - centers).max(1, keepdims=True) < 0.5  # pixels; False for what is not finite
        part = np.where(is_shown, np.clip(xy - 0.5, -1e4, 1e5), -1e4)
        positions[:, top : top + num_rows] = part.T.reshape(2, -1, width)
    return positions
