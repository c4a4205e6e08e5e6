"""SIFT features of one photo, and how alike photos are by their coarsest ones.

OpenCV's SIFT takes a quarter to a third of the time of COLMAP's on the processor; as many features have its contrast
(Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004). Descriptors are compared by their
square roots (Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.poses.numbers import STRUCTURE

Floats = NDArray[np.float32]
Photo = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Sift:
    """Features of a photo.

    Attributes:
        px: (N, 2) float32, pixels of the photo, pixel centres at half integers.
        scale: (N,) float32, standard deviation of the blur at which the feature was found, pixels of the photo.
        angle: (N,) float32, radians.
        descriptors: (N, 128) uint8, square roots of histograms, `STRUCTURE.unit` long (to rounding).
    """

    px: Floats
    scale: Floats
    angle: Floats
    descriptors: NDArray[np.uint8]


def find_sift(photo: Photo, *, image_size: int, most: int) -> Sift:
    """The features of most contrast of a photo (H, W, 3) uint8 RGB, at most `most`; a photo whose longer side has more
    than `image_size` pixels is scaled down to it."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    factor = min(1.0, image_size / max(grey.shape))
    size = tuple(max(1, round(factor * side)) for side in grey.shape[::-1])
    small = grey if factor == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    contrast, edge = STRUCTURE.contrast, STRUCTURE.edge
    finder = cv2.SIFT.create(most, contrastThreshold=contrast, edgeThreshold=edge, enable_precise_upscale=True)
    points, histograms = finder.detectAndCompute(small, None)
    if not points:
        none = np.zeros(0, np.float32)
        return Sift(px=none.reshape(0, 2), scale=none, angle=none, descriptors=np.zeros((0, 128), np.uint8))
    # `most` is exceeded by ties and by features with two directions
    points, histograms = points[:most], np.asarray(histograms[:most], np.float32)
    zoom = np.array(grey.shape[::-1], np.float32) / size
    roots = np.sqrt(histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9))
    px = np.array([point.pt for point in points], np.float32) + 0.5  # OpenCV's pixel centres are whole numbers
    return Sift(
        px=px * zoom,
        scale=np.array([point.size / 2 for point in points], np.float32) * zoom.max(),
        angle=np.radians(np.array([point.angle for point in points], np.float32)),
        descriptors=np.clip(np.rint(STRUCTURE.unit * roots), 0, 255).astype(np.uint8),
    )


def coarsest(sift: Sift) -> NDArray[np.uint8]:
    """(C, 128): descriptors of the features of largest scale, `STRUCTURE.coarse` at most, which are seen best from
    elsewhere (Wu, Towards linear-time incremental structure from motion, 3DV 2013)."""
    return sift.descriptors[np.argsort(-sift.scale, kind="stable")[: STRUCTURE.coarse]]


def count_alike(photos: Sequence[NDArray[np.uint8]]) -> NDArray[np.int64]:
    """(V, V): how many coarse features of V photos match, from `coarsest` of each; symmetric, 0 on the diagonal."""
    alike = np.zeros((len(photos), len(photos)), np.int64)
    for i, j in combinations(range(len(photos)), 2):
        alike[i, j] = alike[j, i] = len(match_descriptors(photos[i], photos[j]))
    return alike


def match_descriptors(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(M, 2) rows of descriptors (A, 128) and (B, 128) that match: each is the other's nearest, and nearer than
    `STRUCTURE.ratio` of the second nearest."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2), np.int64)
    one, other = (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9) for rows in (one, other))
    cosines = one.astype(np.float32) @ other.astype(np.float32).T
    return np.argwhere(_clear_best(cosines, STRUCTURE.ratio) & _clear_best(cosines.T, STRUCTURE.ratio).T)


def _clear_best(cosines: Floats, ratio: float) -> NDArray[np.bool_]:
    """(A, B) bool: the nearest of B for each of A rows, where it is nearer than `ratio` of the second nearest."""
    second, best = np.partition(cosines, -2, axis=1)[:, -2:].T
    near = 2 - 2 * best <= ratio**2 * (2 - 2 * second)  # squared distances of descriptors of length 1
    return (cosines == best[:, None]) & near[:, None]
