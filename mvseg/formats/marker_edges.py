"""Edges of a printed marker, whatever a photo does to light.

Blur mixes light, and a camera's tone curve bends it: the edge is not halfway between the values of black and white, but
a bit outside of the black, or inside with another curve, and sides of markers come out some per cent too short or too
long. Inside a marker, white follows black and black follows white: both kinds of edges are off by the same shift in
opposite directions. So the grid of modules and the shift are fitted together, and then the black square to its own
edges, the shift taken off: modules may be irregular (those of images are whole pixels), the square has a known side.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mvseg.arrays import Floats

ALONG = np.linspace(-0.3, 0.3, 5)  # where an edge between two modules is looked at, in modules from its middle
PASSES = 3  # limit: OpenCV's quads are right to a pixel or two; the third pass moves corners by 0.002 pixels
ACROSS = np.linspace(-0.5, 0.5, 25)  # in modules, from the middle of one to that of the other


def fit_grid(photo: NDArray[np.uint8], quad: Floats, is_white: NDArray[np.bool_]) -> Floats:
    """The corners of a marker, (4, 2) pixels, from all edges between its black and white modules.

    Args:
        photo: (H, W), values of any tone curve.
        quad: (4, 2) pixels, right to a quarter of a module, clockwise from its top left; the centre of the photo's
            first pixel is (0.5, 0.5).
        is_white: (M, M) its modules, with the black border.
    """
    square = len(is_white) * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    for _ in range(PASSES):
        homography = cv2.getPerspectiveTransform(square.astype(np.float32), quad.astype(np.float32))
        px_from_grid: Floats = np.asarray(homography, np.float64)
        axes = [_find_edges(photo, px_from_grid, white, axis) for axis, white in enumerate((is_white, is_white.T))]
        rows, places, is_outer = (np.concatenate(each) for each in zip(*axes, strict=True))
        shift = np.linalg.lstsq(rows, places, rcond=None)[0][8]
        fit = np.linalg.lstsq(rows[is_outer, :8], (places - shift * rows[:, 8])[is_outer], rcond=None)[0]
        moves = np.column_stack([np.ones(4), square]) @ fit[:6].reshape(2, 3).T + square * (square @ fit[6:8])[:, None]
        quad = np.asarray(cv2.perspectiveTransform((square + moves)[None], px_from_grid)[0], np.float64)
    return quad


def _find_edges(
    photo: NDArray[np.uint8], px_from_grid: Floats, is_white: NDArray[np.bool_], axis: int
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """E edges across one axis of the grid: (E, 9) derivatives by homography and shift, places, and if of the square."""
    outside = np.pad(is_white, ((0, 0), (1, 1)), constant_values=True).astype(int)
    steps = np.diff(outside, axis=1)  # 1 where white follows black, -1 where black follows white
    row, line = np.nonzero(steps)
    step = steps[row, line]
    across, along = np.broadcast_arrays(line[:, None, None] + ACROSS, row[:, None, None] + 0.5 + ALONG[:, None])
    grid = np.stack([across, along] if axis == 0 else [along, across], -1)  # (E, along, across, 2)
    px = cv2.perspectiveTransform(grid.reshape(1, -1, 2), px_from_grid)[0] - 0.5  # pixels of arrays
    values = map_coordinates(photo, px.T[::-1], output=np.float64, order=1, mode="nearest").reshape(across.shape)
    rising = values.mean(1) * step[:, None]
    half = (rising[:, 0] + rising[:, -1]) / 2
    after = (rising > half[:, None]).argmax(1)
    crossed = np.flatnonzero(after > 0)
    low, high = rising[crossed, after[crossed] - 1], rising[crossed, after[crossed]]
    places = ACROSS[after[crossed] - 1] + (half[crossed] - low) / (high - low) * (ACROSS[1] - ACROSS[0])
    middle = np.column_stack([line, row + 0.5] if axis == 0 else [row + 0.5, line])[crossed]
    rows = np.zeros((len(crossed), 9))
    rows[:, 3 * axis : 3 * axis + 3] = np.column_stack([np.ones(len(crossed)), middle])
    rows[:, 6:8] = middle[:, axis, None] * middle
    rows[:, 8] = step[crossed]
    return rows, places, np.isin(line[crossed], (0, len(is_white)))
