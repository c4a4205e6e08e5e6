"""Pot, soil and ground, and the meshes of all that is not a leaf: tubes and turned profiles. World units are
millimetres, +z is up and the soil is at z = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import grid_faces
from mvseg.simulation.blades import Ints
from mvseg.simulation.families import Family

TUBE_SIDES = 8  # limit: sides of a tube
ROUND = 48  # limit: sides of a round pot


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh that is not a leaf: vertices (P, 3) float64 in mm, faces (F, 3) int32, material "stem" (petioles too),
    "pot", "soil", "ground" or "stake"."""

    material: str
    vertices: Floats
    faces: Ints


@dataclass(frozen=True)
class Pot:
    """A pot of radius and height in mm, its soil at z = 0, the ground at z = -height; height 0 is a bed."""

    radius: float
    height: float
    sides: int


def draw_pot(family: Family, rng: np.random.Generator) -> Pot:
    """A round or square pot, or a bed."""
    radius = family.pot_radius * rng.uniform(0.85, 1.2)
    return Pot(radius, radius * rng.uniform(1.1, 1.8) * (rng.random() > 0.2), 4 if rng.random() < 0.2 else ROUND)


def lift(pot: Pot, points: Floats) -> Floats:
    """The points (P, 3) with those below the soil, the rim or the ground lifted smoothly above it."""
    outside = np.clip((np.linalg.norm(points[:, :2], axis=1) - pot.radius - 6) / 40, 0, 1)
    floor = 4 - pot.height * outside**2 * (3 - 2 * outside)
    return np.column_stack([points[:, :2], floor + 2 * np.logaddexp(0, (points[:, 2] - floor) / 2)])


def pot_parts(pot: Pot, rng: np.random.Generator) -> list[Part]:
    """The pot, its soil and the ground as meshes."""
    wide = [(0.5 * 1.35**ring, -pot.height) for ring in range(rng.integers(21, 32))]
    if not pot.height:
        return [revolve("soil", wide, sides=ROUND, bumps=rng.normal(-1, 0.8, (len(wide), ROUND)))]
    wall = [(0.75, -pot.height), (1.0, -14.0), (1.06, -14.0), (1.06, 2.0), (0.99, 2.0), (0.99, -8.0)]
    soil = [(0.5 + (pot.radius - 0.5) * ring / 12, -1.0) for ring in range(13)]
    return [
        revolve("pot", [(pot.radius * ratio, z) for ratio, z in wall], sides=pot.sides),
        revolve("soil", soil, sides=pot.sides, bumps=rng.normal(0, 1.2, (len(soil), pot.sides))),
        revolve("ground", wide, sides=ROUND),
    ]


def revolve(material: str, profile: list[tuple[float, float]], *, sides: int, bumps: Floats | float = 0.0) -> Part:
    """The surface that a profile of (radius, z) pairs sweeps around the z axis; `bumps` (rings, sides) adds to z."""
    radius, z = np.array(profile).T[:, :, None]
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    grid = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle) + z + bumps], -1)
    return Part(material, grid.reshape(-1, 3), ring_faces(len(profile), sides))


def make_tube(material: str, points: Floats, *, radius: float, taper: float) -> Part:
    """A tube around (n, 3) points whose radius goes from `radius` to `radius * taper`."""
    along = np.gradient(points, axis=0)
    least = np.eye(3)[np.argmin(np.abs(along).max(0))]  # the axis that the tube follows least
    first = np.cross(along, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first) / np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, TUBE_SIDES, endpoint=False)[:, None]
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    vertices = points[:, None] + radius * np.linspace(1, taper, len(points))[:, None, None] * ring
    return Part(material, vertices.reshape(-1, 3), ring_faces(len(points), TUBE_SIDES))


def ring_faces(num_rings: int, sides: int) -> Ints:
    """(F, 3) faces between closed rings of vertices that follow each other."""
    grid = np.arange(num_rings * sides).reshape(num_rings, sides)
    return grid_faces(np.concatenate([grid, grid[:, :1]], 1)).astype(np.int32)
