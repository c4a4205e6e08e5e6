"""A printed ChArUco board, as users describe it. Does not import torch: options are parsed before torch is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from mvseg.arrays import Floats
from mvseg.errors import InputError

# Marker dictionaries, by OpenCV's names; the one with the most markers in the photos is used.
Family = Literal["4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36H11"]
FAMILIES: tuple[Family, ...] = get_args(Family)
MAX_SQUARES = 200  # limit: squares along a side of a board


@dataclass(frozen=True)
class BoardConfig:
    """A printed ChArUco board; its frame has the origin in a corner, x and y in the board, z out of it, towards the
    viewer.

    Attributes:
        columns: squares in a row.
        rows: squares in a column.
        square: side of a square.
        marker: side of a marker, in the unit of `square`.
        family: OpenCV's name of the marker dictionary; for DICT_5X5_100 use 5X5_1000, which begins with the same
            markers.
        legacy: the pattern of boards from before OpenCV 4.6 (they differ if `rows` is even).
    """

    columns: int
    rows: int
    square: float
    marker: float
    family: Family = "5X5_1000"
    legacy: bool = False

    def __post_init__(self) -> None:
        if not (2 <= self.columns <= MAX_SQUARES and 2 <= self.rows <= MAX_SQUARES):
            raise InputError(f"the board has {self.columns} x {self.rows} squares, expected 2 x 2 to {MAX_SQUARES}")
        if not 0 < self.marker < self.square < np.inf:
            lengths = f"the markers have {self.marker:g}, the squares {self.square:g}"
            raise InputError(f"{lengths}: expected 0 < marker < square")

    def corners(self) -> Floats:
        """(P, 3) inner corners of the squares, by OpenCV's numbers, in the unit of `square`."""
        # OpenCV's y runs down the board and its z into it: turned about x, with the origin at the bottom left
        corners = np.array(self.opencv().getChessboardCorners(), float)
        return np.asarray(corners * [1, -1, -1] + [0, self.rows * self.square, 0])

    def opencv(self) -> cv2.aruco.CharucoBoard:
        dictionary = marker_dictionary(self.family)
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


def marker_dictionary(family: Family) -> cv2.aruco.Dictionary:
    """OpenCV's markers of a family."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
