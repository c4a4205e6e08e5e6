"""A tube: a curve with a radius along it, world frame and units.

The axis is a clamped cubic B-spline with six vector coefficients, u in [0, 1]; its radius is a quadratic one with three
coefficients. Both are linear in their coefficients, as leaf patches are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import FIT, TUBE
from mvseg.reconstruction.surface.leaf_patch import spline_basis

COUNTS = (6, 3)  # definition: coefficients of the axis, vectors, and of the radius
AXIS, RADIUS = COUNTS
NUM_ROWS, NUM_SIDES = TUBE.mesh


@dataclass(frozen=True, eq=False)
class Tube:
    """One stem, or one internode, petiole or twig.

    Attributes:
        axis: (6, 3) float64 coefficients; NaN where no tube could be fitted.
        radii: (3,) float64 coefficients of the radius.
        iou: (S,) float64, with the mask in each view it was fitted to, without the pixels of instances that may hide
            it.
    """

    axis: Floats
    radii: Floats
    iou: Floats

    @staticmethod
    def none() -> Tube:
        """No tube."""
        return Tube(np.full((AXIS, 3), np.nan), np.full(RADIUS, np.nan), np.zeros(0))

    @staticmethod
    def along(points: Floats) -> Tube:
        """A tube of no radius along points (P, 3)."""
        return Tube(fit_axis(points), np.zeros(RADIUS), np.zeros(0))

    @property
    def exists(self) -> bool:
        """Is there a tube at all?"""
        return bool(np.isfinite(self.axis).all())

    def points(self, u: Floats | None = None) -> Floats:
        """(P, 3) of the axis at places u (P,), by default `NUM_ROWS` from end to end."""
        return spline_basis(tube_places(NUM_ROWS) if u is None else u, AXIS) @ self.axis

    def radius(self, u: Floats | None = None) -> Floats:
        """(P,) at places u (P,), by default `NUM_ROWS` from end to end."""
        return np.maximum(spline_basis(tube_places(NUM_ROWS) if u is None else u, RADIUS) @ self.radii, 0)

    @cached_property
    def length(self) -> float:
        """Along the axis."""
        return float(np.linalg.norm(np.diff(self.points(), axis=0), axis=1).sum())

    @property
    def diameter(self) -> float:
        """Median along the axis."""
        return 2 * float(np.median(self.radius()))

    def reverse(self) -> Tube:
        """The same tube from its other end."""
        return replace(self, axis=self.axis[::-1], radii=self.radii[::-1])

    def mesh(self) -> trimesh.Trimesh:
        """Closed mesh with normals outwards; empty without a tube."""
        if not self.exists:
            return trimesh.Trimesh()
        return sweep_circle(self.points(), self.radius())


def tube_places(count: int) -> Floats:
    """(count,) even places u from 0 to 1."""
    return np.linspace(0, 1, count)


def axis_slopes(u: Floats) -> Floats:
    """(P, 6) rows that give dx/du of the axis at places u (P,)."""
    low, high = np.clip(u - FIT.difference, 0, 1), np.clip(u + FIT.difference, 0, 1)
    slopes: Floats = (spline_basis(high, AXIS) - spline_basis(low, AXIS)) / (high - low)[:, None]
    return slopes


def fit_axis(points: Floats) -> Floats:
    """(6, 3) coefficients of the axis that is nearest to points (P, 3) in their order, P >= 2, from end to end."""
    along = np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
    u = along / max(along[-1], 1e-300)
    rows = np.concatenate([spline_basis(u, AXIS), 1e-3 * np.diff(np.eye(AXIS), 3, axis=0)])
    target = np.concatenate([points, np.zeros((AXIS - 3, 3))])
    return np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0])


def sweep_circle(points: Floats, radius: Floats) -> trimesh.Trimesh:
    """Closed tube around a polyline (P, 3) with radii (P,)."""
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    first = np.eye(3)[np.argmin(np.abs(along).max(0))]
    angle = np.linspace(0, 2 * np.pi, NUM_SIDES, endpoint=False)
    rings = []
    for point, ahead, size in zip(points, along, radius, strict=True):
        first = first - (first @ ahead) * ahead  # carried along, so that the mesh does not twist
        first = first / max(float(np.linalg.norm(first)), 1e-300)
        second = np.cross(ahead, first)
        rings.append(point + size * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second))
    vertices = np.concatenate([*rings, points[[0, -1]]])
    grid = np.arange(len(points) * NUM_SIDES).reshape(len(points), NUM_SIDES)
    a, b = grid[:-1], np.roll(grid, -1, 1)[:-1]
    c, d = grid[1:], np.roll(grid, -1, 1)[1:]
    sides = np.concatenate([np.stack([a, b, c], 2), np.stack([b, d, c], 2)]).reshape(-1, 3)
    ends = [
        np.stack([np.full(NUM_SIDES, len(vertices) - 2), np.roll(grid[0], -1), grid[0]], 1),
        np.stack([np.full(NUM_SIDES, len(vertices) - 1), grid[-1], np.roll(grid[-1], -1)], 1),
    ]
    return trimesh.Trimesh(vertices, np.concatenate([sides, *ends]), process=False)
