"""Printed markers in photos: ArUco and AprilTag markers, and the boards of ChArUco, found by OpenCV.

OpenCV has the centre of the top-left pixel at (0, 0); here it is at (0.5, 0.5), as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.formats.board import FAMILIES, BoardConfig, Family, marker_dictionary
from mvseg.formats.marker_edges import fit_grid
from mvseg.formats.photos import Photos
from mvseg.system.running import progress_bar

Grey = NDArray[np.uint8]
Corner = tuple[int, int]  # a marker and its corner, 0 to 3, clockwise from its top left
Seen = dict[Corner, list[tuple[int, Floats]]]  # {corner: (view, (2,) pixels) wherever it is seen}


def find_markers(photo: Grey, family: Family) -> dict[int, Floats]:
    """Markers of a family in one photo (H, W) uint8 without lens distortion: {number of the marker: (4, 2) corners in
    pixels, clockwise from its top left, see `fit_grid`}. A marker that appears twice is ambiguous and left out."""
    dictionary = marker_dictionary(family)
    quads, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(photo)
    numbers, markers = [] if ids is None else [int(number) for number in ids.ravel()], {}
    for number, quad in zip(numbers, quads, strict=True):
        if numbers.count(number) == 1:
            modules = dictionary.generateImageMarker(number, dictionary.markerSize + 2, borderBits=1)
            markers[number] = fit_grid(photo, np.asarray(quad, float).reshape(4, 2) + 0.5, modules > 0)
    return markers


def find_scene_markers(photos: Photos, families: Sequence[Family] = FAMILIES) -> dict[Family, Seen]:
    """Corners of the markers in all photos of a scene, by family. Raises InputError if a photo is missing or broken."""
    markers: dict[Family, Seen] = {family: {} for family in families}
    for view in progress_bar(range(len(photos.scene.views)), name="markers", unit="photo"):
        photo = read_grey(photos, view)
        for family, seen in markers.items():
            for marker, quad in find_markers(photo, family).items():
                for corner, px in enumerate(quad):
                    seen.setdefault((marker, corner), []).append((view, px))
    return markers


def read_grey(photos: Photos, view: int) -> Grey:
    """(H, W) uint8: the photo of a view without colours and lens distortion."""
    return np.asarray(cv2.cvtColor(photos(view), cv2.COLOR_RGB2GRAY), np.uint8)


def find_board(photo: Grey, board: BoardConfig) -> tuple[NDArray[np.int64], Floats]:
    """Inner corners of a ChArUco board in one photo, with lens distortion or without: (P,) numbers, as in
    `BoardConfig.corners`, and (P, 2) pixels; P is 0 where no corner is seen."""
    found, numbers, *_ = cv2.aruco.CharucoDetector(board.opencv()).detectBoard(photo)
    if numbers is None or found is None or not len(numbers):
        return np.zeros(0, np.int64), np.zeros((0, 2))
    return np.asarray(numbers).ravel().astype(np.int64), np.asarray(found, float).reshape(-1, 2) + 0.5
