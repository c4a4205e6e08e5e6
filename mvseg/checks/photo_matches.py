"""Matched features of neighbouring photos: SIFT, on photos scaled down, for few pairs of views."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.checks.cameras import find_coverage
from mvseg.checks.numbers import FEATURES
from mvseg.errors import InputError
from mvseg.formats.photos import ReadPhoto
from mvseg.matching.pencil import is_coincident
from mvseg.poses.sift import Sift, find_sift, match_descriptors
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PhotoMatches:
    """Features that two photos share.

    Attributes:
        views: i and j.
        xy: (2, N, 2) pixels of views i and j: those that have moved.
        is_rigid: (N,) bool, those that fit one fundamental matrix, whichever it is.
        num_still: features at the same pixels of both photos, left out of `xy`.
        unit_px: pixels per unit, see `Cameras.unit_px`.
    """

    views: tuple[int, int]
    xy: Floats
    is_rigid: NDArray[np.bool_]
    num_still: int
    unit_px: float

    @property
    def is_significant(self) -> bool:
        """Whether enough features fit one fundamental matrix to rule out chance."""
        return bool(self.is_rigid.sum() >= max(FEATURES.fewest, FEATURES.least_share * len(self.is_rigid)))


def match_photos(read: ReadPhoto, cameras: Cameras) -> list[PhotoMatches]:
    """The features that neighbouring photos share.

    Args:
        read: the photo of a view; one for which it raises InputError is skipped.
        cameras: V cameras on the CPU, which say what neighbours are.
    """
    pairs = neighbours(cameras)
    wanted = sorted({view for pair in pairs for view in pair})
    features = {}
    for view in progress_bar(wanted, name="features of photos", unit="photo"):
        try:
            features[view] = find_photo_features(read(view))
        except InputError:
            continue
    return [
        match_pair(pair, features[pair[0]], features[pair[1]], unit_px=cameras.unit_px)
        for pair in pairs
        if pair[0] in features and pair[1] in features
    ]


def neighbours(cameras: Cameras) -> list[tuple[int, int]]:
    """Pairs (i, j) of views, i < j, that stand nearly 15 degrees apart as seen from the plant: four for each view, or
    for eight of more than 24 views."""
    num = len(cameras)
    toward = find_coverage(cameras).point - cameras.centers.numpy()
    toward /= np.linalg.norm(toward, axis=1, keepdims=True).clip(min=1e-300)
    angle = np.degrees(np.arccos(np.clip(toward @ toward.T, -1, 1)))
    angle[is_coincident(cameras).numpy()] = np.inf  # a view is at its own place, too
    number = num if num <= FEATURES.most_views else FEATURES.sources
    sources = np.linspace(0, num - 1, number).round().astype(int)
    pairs = set()
    for view in sources.tolist():
        nearest = np.argsort(np.abs(angle[view] - FEATURES.best_angle), kind="stable")[: FEATURES.partners].tolist()
        near = [other for other in nearest if angle[view, other] <= FEATURES.widest_angle]
        pairs |= {(min(view, other), max(view, other)) for other in near}
    return sorted(pairs)


def find_photo_features(photo: NDArray[np.uint8]) -> Sift:
    """Features of a photo (H, W, 3)."""
    return find_sift(photo, image_size=FEATURES.side, most=FEATURES.most_features, contrast=FEATURES.contrast)


def match_pair(views: tuple[int, int], first: Sift, second: Sift, *, unit_px: float) -> PhotoMatches:
    """The features that views i and j share, see `Cameras.unit_px`."""
    index = match_descriptors(first.descriptors, second.descriptors, back_ratio=1.0)
    xy = np.stack((first.px[index[:, 0]], second.px[index[:, 1]])).astype(np.float64)
    has_moved = np.linalg.norm(xy[0] - xy[1], axis=1) > FEATURES.still * unit_px
    xy = xy[:, has_moved]
    is_rigid = np.zeros(xy.shape[1], bool)
    if len(is_rigid) >= FEATURES.fewest:
        kept = cv2.findFundamentalMat(xy[0], xy[1], cv2.USAC_MAGSAC, FEATURES.tolerance * unit_px, 0.999, 5000)[1]
        is_rigid = is_rigid if kept is None else kept[:, 0] > 0
    return PhotoMatches(views, xy, is_rigid, int((~has_moved).sum()), unit_px)
