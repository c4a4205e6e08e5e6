"""The axis of a stem: a polyline with a radius at each point, world frame and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import AXES, STEM
from mvseg.reconstruction.surface.leaf_surface import LeafSurface


@dataclass(frozen=True, eq=False)
class StemAxis:
    """One stem, or one internode of it: P >= 2 points (P, 3) from end to end, and the radius (P,) there, 0 where no
    mask shows how thick it is."""

    points: Floats
    radius: Floats

    @staticmethod
    def along(points: Floats) -> StemAxis:
        """An axis of no radius."""
        return StemAxis(points, np.zeros(len(points)))

    @staticmethod
    def of_surface(surface: LeafSurface) -> StemAxis:
        """Half way between the sides of the patch that was fitted to masks of a stem. Patches bend around stems, so the
        midrib lies on one side."""
        sides = surface.points(AXES.points, 3).numpy()[:, [0, 2]]
        return StemAxis(sides.mean(1), np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1) / 2)

    @property
    def length(self) -> float:
        """Along the axis."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def extension(self) -> float:
        """By how much `extend` lengthens it at each end."""
        return AXES.beyond * self.length

    @property
    def extended_reach(self) -> Floats:
        """(P + 2,) distances of the points of `extend` from the first one, along them."""
        return np.append(0, np.linalg.norm(np.diff(self.extend(), axis=0), axis=1).cumsum())

    def reverse(self) -> StemAxis:
        """The same axis from its other end."""
        return replace(self, points=self.points[::-1], radius=self.radius[::-1])

    def extend(self) -> Floats:
        """(P + 2, 3) its points, and one beyond each end, straight on."""
        ends = self.points[[0, -1]]
        ahead = ends - self.points[[min(3, len(self.points) - 1), max(-4, -len(self.points))]]
        ahead *= self.extension / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-300)
        return np.concatenate([ends[:1] + ahead[:1], self.points, ends[1:] + ahead[1:]])

    def reach(self, places: Sequence[Sequence[float]]) -> StemAxis:
        """The axis, straight on to the farthest of these places, on `extend`, that lie beyond either end."""
        axis = self
        for _ in range(2):  # each end in turn
            end = axis.points[-1]
            beyond = (np.array(places).reshape(-1, 3) - end) @ (end - axis.points[-2])
            if len(places) and beyond.max() > 0:
                points = np.append(axis.points, [places[int(beyond.argmax())]], axis=0)
                axis = StemAxis(points, np.append(axis.radius, axis.radius[-1]))
            axis = axis.reverse()
        return axis


def sweep_circle(points: Floats, radius: Floats) -> trimesh.Trimesh:
    """Closed tube around a polyline (P, 3) with radii (P,), normals outwards."""
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    first = np.eye(3)[np.argmin(np.abs(along).max(0))]
    angle = np.linspace(0, 2 * np.pi, STEM.sides, endpoint=False)
    rings = []
    for point, ahead, size in zip(points, along, radius, strict=True):
        first = first - (first @ ahead) * ahead  # carried along, so that the mesh does not twist
        first = first / max(float(np.linalg.norm(first)), 1e-300)
        second = np.cross(ahead, first)
        rings.append(point + size * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second))
    vertices = np.concatenate([*rings, points[[0, -1]]])
    grid = np.arange(len(points) * STEM.sides).reshape(len(points), STEM.sides)
    a, b = grid[:-1], np.roll(grid, -1, 1)[:-1]
    c, d = grid[1:], np.roll(grid, -1, 1)[1:]
    sides = np.concatenate([np.stack([a, b, c], 2), np.stack([b, d, c], 2)]).reshape(-1, 3)
    ends = [
        np.stack([np.full(STEM.sides, len(vertices) - 2), np.roll(grid[0], -1), grid[0]], 1),
        np.stack([np.full(STEM.sides, len(vertices) - 1), grid[-1], np.roll(grid[-1], -1)], 1),
    ]
    return trimesh.Trimesh(vertices, np.concatenate([sides, *ends]), process=False)
