"""Leaf blades as meshes of known area, length and width.

A blade is a grid mapped through its midrib: an arc with droop, sweep and twist, and a folded, curled and rippled
cross-section. Lengths are millimetres, angles radians, +z is up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import grid_triangles

Ints = NDArray[np.int32]

BLADE_COLUMNS = 9  # limit: vertices across a blade; odd, so that the midrib is a grid line


@dataclass(frozen=True, eq=False)
class Leaf:
    """One leaf blade (of a compound leaf: one leaflet), a thin surface with two sides.

    Attributes:
        leaf_id: >= 1, the same in every view.
        vertices: (P, 3) float64, world frame, mm.
        faces: (F, 3) int32, wound so that the normal is the upper side.
        uv: (P, 2) float64; u runs from 0 at the base to 1 at the tip, v from -1 to 1 across the blade, 0 on the midrib.
        length: along the midrib, mm.
        width: from edge to edge along the surface, where the blade is widest, mm (the flattened blade's width).
        area: one-sided area of the mesh, mm^2.
        dryness: 0 fresh, 0.5 yellow, 1 brown.
    """

    leaf_id: int
    vertices: Floats
    faces: Ints
    uv: Floats
    length: float
    width: float
    area: float
    dryness: float = 0.0


@dataclass(frozen=True)
class Blade:
    """The shape of one blade before it is placed; fields as in `families.Family`, but single numbers and radians."""

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


@dataclass(frozen=True, eq=False)
class Arc:
    """A curve of straight pieces that bends evenly: a midrib, a petiole, a stem.

    Attributes:
        azimuth, elevation: direction at its start, radians.
        steps: (n,) lengths of the pieces, mm.
        droop, sweep: by how much it bends down and sideways in all, radians.
    """

    azimuth: float
    elevation: float
    steps: Floats
    droop: float = 0.0
    sweep: float = 0.0


def arc_angles(arc: Arc) -> tuple[Floats, Floats]:
    """Pitch (n,) and heading (n,) of the pieces of an arc."""
    middle = (np.cumsum(arc.steps) - arc.steps / 2) / arc.steps.sum()
    return arc.elevation - arc.droop * middle**1.3, arc.azimuth + arc.sweep * middle


def arc_points(base: Floats, arc: Arc) -> Floats:
    """(n + 1, 3) points of an arc that leaves `base` (3,); neighbours are exactly `arc.steps` apart."""
    pitch, heading = arc_angles(arc)
    ahead = np.stack([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)], 1)
    return base + np.concatenate([np.zeros((1, 3)), np.cumsum(arc.steps[:, None] * ahead, 0)])


def blade_stations(rows: int) -> Floats:
    """(rows + 2,) positions along the midrib from 0 to 1, denser at both ends, where the outline is round."""
    even = np.linspace(0, 1, rows + 2)
    return 0.4 * even + 0.6 * (1 - np.cos(np.pi * even)) / 2


def half_widths(blade: Blade) -> Floats:
    """(rows,) half-widths of the flattened blade at its inner stations, mm; the largest is width / 2."""
    u = blade_stations(blade.rows)[1:-1]
    half = u ** blade.outline[0] * (1 - u) ** blade.outline[1]
    num_lobes, depth = blade.lobes
    wave = 2 * np.pi * num_lobes * u**0.85
    half = half * (1 - depth * (0.5 + 0.5 * np.cos(wave + 0.6 * np.sin(wave))) * u**0.3)  # lobes lean to the tip
    half = half * (1 + blade.teeth * (-1.0) ** np.arange(blade.rows))
    return blade.width / 2 * half / half.max()


def place_blade(blade: Blade, base: Floats, *, azimuth: float, elevation: float) -> Floats:
    """(P, 3) vertices of a blade whose midrib leaves `base` (3,) towards `azimuth` at `elevation`."""
    u = blade_stations(blade.rows)
    steps = np.diff(u) * blade.length
    arc = Arc(azimuth=azimuth, elevation=elevation, steps=steps, droop=blade.droop, sweep=blade.sweep)
    points = arc_points(base, arc)
    midrib, tip = points[1:-1], points[-1]
    pitch, heading = ((angle[1:] + angle[:-1]) / 2 for angle in arc_angles(arc))
    level = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], 1)
    upright = np.stack([-np.sin(pitch) * np.cos(heading), -np.sin(pitch) * np.sin(heading), np.cos(pitch)], 1)
    turn = (blade.roll + blade.twist * u[1:-1])[:, None]
    side, up = np.cos(turn) * level + np.sin(turn) * upright, np.cos(turn) * upright - np.sin(turn) * level

    # the cross-section is a chain of equal pieces from the midrib to the edge, so folding does not change the width
    pieces = BLADE_COLUMNS // 2
    slope = blade.fold + blade.curl * (np.arange(pieces) + 0.5) / pieces
    out, lift = (np.concatenate([[0.0], np.cumsum(part)]) / pieces for part in (np.cos(slope), np.sin(slope)))
    v = np.linspace(-1, 1, BLADE_COLUMNS)
    waves = blade.ripple * v**2 * np.sin(18 * u[1:-1, None] + blade.phase + 1.7 * np.sign(v))
    half = half_widths(blade)[:, None]
    sideways = half * np.concatenate([-out[:0:-1], out])
    upwards = half * (np.concatenate([lift[:0:-1], lift]) + waves)
    grid = midrib[:, None] + sideways[..., None] * side[:, None] + upwards[..., None] * up[:, None]
    return np.concatenate([base[None], grid.reshape(-1, 3), tip[None]])


def leaf_from_blade(leaf_id: int, vertices: Floats) -> Leaf:
    """The leaf whose vertices (P, 3) `place_blade` returned, with its length, width and area."""
    grid = vertices[1:-1].reshape(-1, BLADE_COLUMNS, 3)
    faces = grid_triangles(len(grid) + 2, BLADE_COLUMNS).astype(np.int32)  # fans at base and tip, a grid between
    midrib = np.concatenate([vertices[:1], grid[:, BLADE_COLUMNS // 2], vertices[-1:]])
    length = float(np.linalg.norm(np.diff(midrib, axis=0), axis=1).sum())
    width = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).sum(1).max())
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    u, v = np.meshgrid(blade_stations(len(grid))[1:-1], np.linspace(-1, 1, BLADE_COLUMNS), indexing="ij")
    uv = np.concatenate([[[0.0, 0.0]], np.stack([u.ravel(), v.ravel()], 1), [[1.0, 0.0]]])
    return Leaf(leaf_id=leaf_id, vertices=vertices, faces=faces, uv=uv, length=length, width=width, area=float(area))
