"""Lens distortion: removed from photos and masks once, on load, and put back when labels are written.

The undistorted image has the size and the K of the photo; only the distortion is gone. What the photo does not show is
black (nothing, in masks). Every camera model of COLMAP works, through pycolmap; a rig file's OpenCV coefficients are
COLMAP's FULL_OPENCV.
"""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap


def photo_from_pinhole(lens: pycolmap.Camera, K: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Where undistorted pixel positions lie in the photo: (P, 2) -> (P, 2) float64, pixel centres at half integers."""
    rays = np.linalg.solve(K, np.concatenate([xy, np.ones((len(xy), 1))], 1).T).T
    return np.asarray(lens.img_from_cam(rays))


def pinhole_from_photo(lens: pycolmap.Camera, K: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Where photo positions lie in the undistorted image: (P, 2) -> (P, 2) float64; the inverse of the above."""
    rays = np.asarray(lens.cam_from_img(np.ascontiguousarray(xy, dtype=np.float64)))
    return rays @ K[:2, :2].T + K[:2, 2]


def undistort(image: np.ndarray, lens: pycolmap.Camera | None, K: np.ndarray) -> np.ndarray:
    """The photo or label map as the pinhole K sees it: same shape and dtype; labels (2-D) are never mixed."""
    return image if lens is None else _resample(image, photo_from_pinhole(lens, K, _centers(image)))


def distort(image: np.ndarray, lens: pycolmap.Camera | None, K: np.ndarray) -> np.ndarray:
    """The inverse of `undistort`: an undistorted image or label map as the photo's own lens sees it."""
    return image if lens is None else _resample(image, pinhole_from_photo(lens, K, _centers(image)))


def _centers(image: np.ndarray) -> np.ndarray:
    rows, columns = np.indices(image.shape[:2])
    return np.stack((columns.ravel(), rows.ravel()), 1) + 0.5


def _resample(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Look up `image` at positions (H W, 2); a position that is not finite or outside gives 0."""
    xy = np.where(np.isfinite(xy), xy, -1e4).reshape(*image.shape[:2], 2)
    zero_centred = np.clip(xy - 0.5, -1e4, 1e5).astype(np.float32)  # cv2.remap counts from pixel centres
    how = cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_LINEAR
    nothing = np.empty(0, np.float32)  # the second map of two; the first holds both coordinates
    return np.asarray(cv2.remap(image, zero_centred, nothing, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
