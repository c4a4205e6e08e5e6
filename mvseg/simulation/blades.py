"""Leaf blades as meshes of known area, length and width.

A blade is a grid mapped through its midrib: an arc with droop, sweep and twist, and a folded, curled and rippled
cross-section. Lengths are millimetres, angles radians, +z is up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

BLADE_COLUMNS = 9  # vertices across a blade; odd, so that the midrib is a grid line


@dataclass(frozen=True, eq=False)
class Leaf:
    """One leaf blade (of a compound leaf: one leaflet), a thin surface with two sides.

    Attributes:
        leaf_id: >= 1, the same in every view.
        vertices: (P, 3) float64, world frame, mm.
        faces: (F, 3) int32, wound so that the normal is the upper side.
        uv: (P, 2) float64; u runs from 0 at the base to 1 at the tip, v from -1 to 1 across the blade, 0 on the midrib.
        length: along the midrib, mm.
        width: from edge to edge along the surface, at the widest place of the midrib, mm (the flattened blade's width).
        area: one-sided area of the mesh, mm^2.
    """

    leaf_id: int
    vertices: Floats
    faces: Ints
    uv: Floats
    length: float
    width: float
    area: float


@dataclass(frozen=True)
class Blade:
    """The shape of one blade before it is placed; fields as in `plants.Family`, but single numbers and radians."""

    length: float
    width: float
    outline: tuple[float, float]
    droop: float = 0.0
    sweep: float = 0.0
    twist: float = 0.0
    roll: float = 0.0
    fold: float = 0.0
    curl: float = 0.0
    ripple: float = 0.0
    phase: float = 0.0
    lobes: tuple[int, float] = (0, 0.0)
    teeth: float = 0.0
    rows: int = 28


def blade_stations(rows: int) -> Floats:
    """(rows + 2,) places along the midrib from 0 to 1, denser at both ends, where the outline is round."""
    place = np.linspace(0, 1, rows + 2)
    return 0.4 * place + 0.6 * (1 - np.cos(np.pi * place)) / 2


def blade_faces(rows: int) -> Ints:
    """(F, 3) faces: a fan at the base vertex, a grid of `rows` x BLADE_COLUMNS vertices, a fan at the tip vertex."""
    grid = 1 + np.arange(rows * BLADE_COLUMNS).reshape(rows, BLADE_COLUMNS)
    base, tip = np.zeros(BLADE_COLUMNS - 1), np.full(BLADE_COLUMNS - 1, rows * BLADE_COLUMNS + 1)
    fans = [np.stack([base, grid[0, :-1], grid[0, 1:]], 1), np.stack([tip, grid[-1, 1:], grid[-1, :-1]], 1)]
    return np.concatenate([fans[0], grid_faces(grid), fans[1]]).astype(np.int32)


def grid_faces(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each cell of an (r, c) grid of vertex numbers; their normal is down the rows x along them."""
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    return np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])


def blade_uv(rows: int) -> Floats:
    """(P, 2) base-to-tip and edge-to-edge coordinates of the vertices that `place_blade` gives."""
    u, v = np.meshgrid(blade_stations(rows)[1:-1], np.linspace(-1, 1, BLADE_COLUMNS), indexing="ij")
    return np.concatenate([[[0.0, 0.0]], np.stack([u.ravel(), v.ravel()], 1), [[1.0, 0.0]]])


def half_widths(blade: Blade) -> Floats:
    """(rows,) half-widths of the flattened blade at its inner stations, mm; the largest is width / 2."""
    u = blade_stations(blade.rows)[1:-1]
    half = u ** blade.outline[0] * (1 - u) ** blade.outline[1]
    num_lobes, depth = blade.lobes
    wave = 2 * np.pi * num_lobes * u**0.85
    half = half * (1 - depth * (0.5 + 0.5 * np.cos(wave + 0.6 * np.sin(wave))) * u**0.3)  # lobes lean to the tip
    half = half * (1 + blade.teeth * (-1.0) ** np.arange(blade.rows))
    return blade.width / 2 * half / half.max()


def arc_angles(azimuth: float, elevation: float, steps: Floats, droop: float, sweep: float) -> tuple[Floats, Floats]:
    """Pitch and heading (n,) of the straight pieces, of lengths `steps`, of the curve that `arc_points` gives."""
    middle = (np.cumsum(steps) - steps / 2) / steps.sum()
    return elevation - droop * middle**1.3, azimuth + sweep * middle


def arc_points(base: Floats, azimuth: float, elevation: float, steps: Floats, droop: float, sweep: float) -> Floats:
    """(n + 1, 3) points of a curve that leaves `base` and bends down by `droop` and sideways by `sweep` in all.

    Its pieces have the lengths `steps` (n,) exactly.
    """
    pitch, heading = arc_angles(azimuth, elevation, steps, droop, sweep)
    ahead = np.stack([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)], 1)
    return base + np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:, None] * ahead, 0)])


def place_blade(blade: Blade, base: Floats, azimuth: float, elevation: float) -> Floats:
    """(P, 3) vertices of a blade whose midrib leaves `base` (3,) towards `azimuth` at `elevation`."""
    u = blade_stations(blade.rows)
    steps = np.diff(u) * blade.length
    midrib = arc_points(base, azimuth, elevation, steps, blade.droop, blade.sweep)[1:-1]
    tip = arc_points(base, azimuth, elevation, steps, blade.droop, blade.sweep)[-1]
    angles = arc_angles(azimuth, elevation, steps, blade.droop, blade.sweep)
    pitch, heading = ((x[1:] + x[:-1]) / 2 for x in angles)
    level = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], 1)
    upright = np.stack([-np.sin(pitch) * np.cos(heading), -np.sin(pitch) * np.sin(heading), np.cos(pitch)], 1)
    turn = (blade.roll + blade.twist * u[1:-1])[:, None]
    side, up = np.cos(turn) * level + np.sin(turn) * upright, np.cos(turn) * upright - np.sin(turn) * level

    # the cross-section is a chain of equal pieces from the midrib to the edge, so folding does not change the width
    pieces = BLADE_COLUMNS // 2
    slope = blade.fold + blade.curl * (np.arange(pieces) + 0.5) / pieces
    out, lift = (np.concatenate([[0.0], np.cumsum(f(slope))]) / pieces for f in (np.cos, np.sin))
    v = np.linspace(-1, 1, BLADE_COLUMNS)
    waves = blade.ripple * v**2 * np.sin(18 * u[1:-1, None] + blade.phase + 1.7 * np.sign(v))
    half = half_widths(blade)[:, None]
    sideways = half * np.concatenate([-out[:0:-1], out])
    upwards = half * (np.concatenate([lift[:0:-1], lift]) + waves)
    grid = midrib[:, None] + sideways[..., None] * side[:, None] + upwards[..., None] * up[:, None]
    return np.concatenate([base[None], grid.reshape(-1, 3), tip[None]])


def measure_leaf(leaf_id: int, vertices: Floats, faces: Ints, uv: Floats) -> Leaf:
    """The leaf of one blade's mesh, with its length, width and area."""
    grid = vertices[1:-1].reshape(-1, BLADE_COLUMNS, 3)
    midrib = np.concatenate([vertices[:1], grid[:, BLADE_COLUMNS // 2], vertices[-1:]])
    length = float(np.linalg.norm(np.diff(midrib, axis=0), axis=1).sum())
    width = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).sum(1).max())
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    return Leaf(leaf_id, vertices, faces, uv, length, width, float(area))
