"""What the leaves cover, and which parts of them are lit, seen from straight above.

The cells of all leaves' grids are painted into one picture, the lowest first. A cell is lit where its centre shows the
cell itself, or another one of its leaf that is nearer than the picture can tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.reconstruction.surface.leaf_surface import LeafSurface, cell_normals

Floats = NDArray[np.float64]

PICTURE = 1024  # pixels of its longer side
BITS = 4  # of sub-pixel positions in OpenCV
LEAST_COSINE = 0.05  # of cells that stand upright, which fewer pixels show than their length


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of a leaf's grid, seen from above.

    Attributes:
        area: (rows, columns) float64 of each cell.
        covered: (rows, columns) float64, the horizontal area below each cell.
        is_lit: (rows, columns) bool: no other cell hides it from above.
    """

    area: Floats
    covered: Floats
    is_lit: NDArray[np.bool_]

    @property
    def lit_share(self) -> float:
        """Share of the leaf's area that is lit."""
        return float(self.area[self.is_lit].sum() / self.area.sum())

    @property
    def projected_area(self) -> float:
        """Horizontal area of the lit part: what this leaf, and no leaf above it, covers."""
        return float(self.covered[self.is_lit].sum())


def look_from_above(surfaces: Mapping[int, LeafSurface], frame: Floats) -> dict[int, Cells]:
    """Which cells of the leaves are lit.

    Args:
        surfaces: {instance id: surface that exists}; they hide each other and themselves, and nothing else does.
        frame: (3, 3) rows east, north, up.

    Returns:
        {instance id: cells}.
    """
    if not surfaces:
        return {}
    grids = np.stack([surface.points().numpy() @ frame.T for surface in surfaces.values()])  # (N, rows, columns, 3)
    corners = np.stack([grids[:, :-1, :-1], grids[:, :-1, 1:], grids[:, 1:, 1:], grids[:, 1:, :-1]], -2)
    level = corners[..., :2]
    low, high = level.reshape(-1, 2).min(0), level.reshape(-1, 2).max(0)
    pixel = max(float((high - low).max()), 1e-300) / (PICTURE - 1)
    px = (level - low) / pixel
    picture = np.full((PICTURE, PICTURE), -1, np.int32)
    quads = np.round(px.reshape(-1, 4, 2) * (1 << BITS)).astype(np.int32)
    for cell in np.argsort(corners[..., 2].mean(-1), axis=None, kind="stable").tolist():  # higher ones over lower ones
        cv2.fillConvexPoly(picture, quads[cell], cell, shift=BITS)
    columns, rows = np.moveaxis(np.round(px.mean(-2)).astype(int), -1, 0)
    top = picture[rows, columns]  # the cell that the centre of each cell shows; -1 where none was painted
    normals = np.stack([cell_normals(grid) for grid in grids])
    areas, covered = np.linalg.norm(normals, axis=-1), np.abs(normals[..., 2])
    # Which other cell of the same leaf is in the way, and which is only beside this one?
    centers, reach = corners.mean(-2), np.linalg.norm(np.ptp(corners, axis=-2), axis=-1)
    shown = np.unravel_index(np.maximum(top, 0), top.shape)
    steepness = np.maximum(covered / np.maximum(areas, 1e-300), LEAST_COSINE)
    is_near = np.linalg.norm(centers[shown] - centers, axis=-1) <= reach + reach[shown] + 2 * pixel / steepness
    own = np.arange(len(grids))[:, None, None]
    is_lit = ((shown[0] == own) & is_near) | (top < 0)  # slivers that OpenCV leaves out are not hidden
    return {
        instance: Cells(area=areas[index], covered=covered[index], is_lit=is_lit[index])
        for index, instance in enumerate(surfaces)
    }
