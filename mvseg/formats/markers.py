"""Printed markers in photos: ArUco and AprilTag markers, and the boards of ChArUco, found by OpenCV.

OpenCV has the centre of the top-left pixel at (0, 0); here it is at (0.5, 0.5), as everywhere.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.formats.board import FAMILIES, BoardConfig, Family, marker_dictionary
from mvseg.formats.photos import Photos
from mvseg.system.running import progress_bar

AROUND = 0.5  # of a marker's side: what is around it, and shows where its edges are
LARGER = 2  # times: markers of 25 pixels are found more often
CODED = np.arange(256) / 255
# Light by the value of a pixel (IEC 61966-2-1, sRGB).
LIGHT = np.where(CODED <= 0.04045, CODED / 12.92, ((CODED + 0.055) / 1.055) ** 2.4)

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]
Corner = tuple[int, int]  # a marker and its corner, 0 to 3, clockwise from its top left
Seen = dict[Corner, list[tuple[int, Floats]]]  # {corner: (view, (2,) pixels) wherever it is seen}


def find_markers(photo: Grey, family: Family) -> dict[int, Floats]:
    """Markers of a family in one photo (H, W) uint8 without lens distortion.

    Their corners are where the edges of the black squares are in linear light: blur and pixels average light, and the
    values of a photo (sRGB) are no light. Edges in these would lie inside the squares, whose sides came out 1 to 4 %
    too short.

    Returns:
        {number of the marker: (4, 2) corners in pixels, clockwise from its top left}; a marker that appears twice is
        ambiguous and left out.
    """
    dictionary, parameters = marker_dictionary(family), cv2.aruco.DetectorParameters()
    rough, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(photo)
    numbers = [] if ids is None else [int(number) for number in ids.ravel()]
    # The corner refinement without bias: the others find markers of 20 to 40 pixels 1 to 5 % too small.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector, found = cv2.aruco.ArucoDetector(dictionary, parameters), {}
    for number, quad in zip(numbers, rough, strict=True):
        if numbers.count(number) == 1:
            low, high = quad.reshape(4, 2).min(0), quad.reshape(4, 2).max(0)
            margin = AROUND * (high - low).max()
            x1, y1 = np.floor(low - margin).clip(0).astype(int)
            x2, y2 = np.ceil(high + margin).astype(int)
            light = LIGHT[photo[y1:y2, x1:x2]]
            larger = cv2.resize(255 * light / light.max(), None, fx=LARGER, fy=LARGER, interpolation=cv2.INTER_CUBIC)
            quads, again, _ = detector.detectMarkers(np.rint(larger).clip(0, 255).astype(np.uint8))
            place = {} if again is None else {int(each): index for index, each in enumerate(again.ravel())}
            if number in place:  # (0, 0) is the photo's corner here
                found[number] = np.asarray(quads[place[number]], float).reshape(4, 2) / LARGER + (x1, y1)
    return found


def find_scene_markers(photos: Photos) -> dict[Family, Seen]:
    """Corners of the markers in all photos of a scene, by family.

    Raises:
        InputError: a photo is missing or broken.
    """
    found: dict[Family, Seen] = {family: {} for family in FAMILIES}
    for view in progress_bar(range(len(photos.scene.views)), name="markers", unit="photo"):
        photo = read_grey(photos, view)
        for family, seen in found.items():
            for marker, quad in find_markers(photo, family).items():
                for corner, px in enumerate(quad):
                    seen.setdefault((marker, corner), []).append((view, px))
    return found


def read_grey(photos: Photos, view: int) -> Grey:
    """(H, W) uint8: the photo of a view without colours and lens distortion."""
    return np.asarray(cv2.cvtColor(photos(view), cv2.COLOR_RGB2GRAY), np.uint8)


def find_board(photo: Grey, board: BoardConfig) -> tuple[NDArray[np.int64], Floats]:
    """Inner corners of a ChArUco board in one photo, with lens distortion or without.

    Returns:
        (P,) numbers of the corners, as in `BoardConfig.corners`, and their (P, 2) pixels; P is 0 where none is seen.
    """
    found, numbers, *_ = cv2.aruco.CharucoDetector(board.opencv()).detectBoard(photo)
    if numbers is None or found is None or not len(numbers):
        return np.zeros(0, np.int64), np.zeros((0, 2))
    return np.asarray(numbers).ravel().astype(np.int64), np.asarray(found, float).reshape(-1, 2) + 0.5
