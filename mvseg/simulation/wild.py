"""Features of plants at home and outdoors: withered leaves, cotyledons, buds, woody stems and bare twigs.

World units are millimetres, +z is up and the soil is at z = 0. Angles are radians.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvseg.arrays import Floats
from mvseg.simulation.blades import BLADE_COLUMNS, Arc, Blade, Leaf, arc_points, leaf_from_blade, place_blade
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.pot import Part, make_tube

MOST_LEAVES_WITH_COTYLEDONS = 12  # chosen: older plants have shed them
SOIL_CLEARANCE = 2.0  # chosen: mm; leaves hang down no further


def make_wild(plant: SimulatedPlant, seed: int) -> SimulatedPlant:
    """The plant with some of its leaves withered, and with buds, twigs, woody stems and cotyledons, each by chance.

    `plant` is as `grow_plant` returns it, `seed` >= 0; the same arguments give the same plant, bit for bit. The first
    leaves of the result are those of `plant`, with the same ids; cotyledons are leaves, too, and come after them.
    """
    rng = np.random.default_rng([seed, len(plant.leaves)])
    share_withered = rng.choice([0.0, 0.15, 0.35])
    leaves = [wither(leaf, rng) if rng.random() < share_withered else leaf for leaf in plant.leaves]
    parts = list(plant.parts)
    if rng.random() < 0.4:
        radius = FAMILIES[plant.family].stem_radius * rng.uniform(1.3, 2.5)
        parts[: len(plant.stems)] = [make_tube("stem", stem, radius=radius, taper=0.4) for stem in plant.stems]
    if rng.random() < 0.6:
        parts += [bud for stem in plant.stems for bud in grow_bud(stem[-1], rng)]
    for _ in range(rng.integers(0, 6)):
        parts.append(grow_twig(plant.stems[rng.integers(len(plant.stems))], rng))
    if len(leaves) <= MOST_LEAVES_WITH_COTYLEDONS and rng.random() < 0.3:
        blades, petioles = grow_cotyledons(plant.stems[0], rng)
        leaves += [leaf_from_blade(len(leaves) + 1 + index, blade) for index, blade in enumerate(blades)]
        parts += petioles
    return replace(plant, leaves=tuple(leaves), parts=tuple(parts), is_wild=True)


# --- leaves


def wither(leaf: Leaf, rng: np.random.Generator) -> Leaf:
    """A leaf that dries: it yellows, then browns, rolls up, shrinks and hangs down."""
    dryness = rng.uniform(0.2, 1.0)
    shrunk = leaf.vertices[0] + (1 - 0.35 * dryness * rng.random()) * (leaf.vertices - leaf.vertices[0])
    rolled = roll_up(shrunk, dryness * rng.uniform(-1.5, 3.0))
    return replace(leaf_from_blade(leaf.leaf_id, hang(rolled, dryness * rng.uniform(0.0, 1.8))), dryness=dryness)


def roll_up(vertices: Floats, turn: float) -> Floats:
    """(P, 3) the blade with both halves rolled upwards around the midrib, their edges by `turn`; downwards if negative.
    The midrib stays in place, and distances across the blade stay what they are."""
    grid = vertices[1:-1].reshape(-1, BLADE_COLUMNS, 3)
    middle = BLADE_COLUMNS // 2
    along = np.gradient(np.concatenate([vertices[:1], grid[:, middle], vertices[-1:]]), axis=0)[1:-1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rolled = grid.copy()
    for side in (-1, 1):
        for piece in range(middle):
            inner, outer = middle + side * piece, middle + side * (piece + 1)
            angle = side * turn * (piece + 0.5) / middle
            turned = Rotation.from_rotvec(angle * along).apply(grid[:, outer] - grid[:, inner])
            rolled[:, outer] = rolled[:, inner] + turned
    return np.concatenate([vertices[:1], rolled.reshape(-1, 3), vertices[-1:]])


def hang(vertices: Floats, angle: float) -> Floats:
    """(P, 3) the blade turned down around its base, stiffly, by the angle or as far as the soil allows."""
    ahead = vertices[-1] - vertices[0]
    axis = np.array([ahead[1], -ahead[0], 0.0])  # ahead x up
    length = np.linalg.norm(axis)
    if length == 0:
        return vertices
    to_straight_down = math.pi / 2 + math.atan2(ahead[2], length)
    for share in (1.0, 0.75, 0.5, 0.25):
        down = Rotation.from_rotvec(-share * min(angle, to_straight_down) * axis / length)
        turned: Floats = vertices[0] + down.apply(vertices - vertices[0])
        if turned[:, 2].min() > SOIL_CLEARANCE:
            return turned
    return vertices


def grow_cotyledons(stem: Floats, rng: np.random.Generator) -> tuple[list[Floats], list[Part]]:
    """The vertices (P, 3) of two small round blades at opposite sides of the lower stem, and their petioles."""
    point = stem[1 + rng.integers(max(1, len(stem) // 4))]
    start, size = rng.uniform(0, 2 * np.pi), rng.uniform(10, 24)
    blades, petioles = [], []
    for azimuth in (start, start + np.pi + rng.normal(0, 0.15)):
        elevation, length = rng.uniform(0.1, 0.8), size * rng.uniform(0.85, 1.15)
        arc = Arc(azimuth=azimuth, elevation=elevation, steps=np.full(4, length * rng.uniform(0.1, 0.2)))
        petiole = arc_points(point, arc)
        blade = Blade(
            length=length,
            width=length * rng.uniform(0.6, 0.95),
            outline=(0.6, rng.uniform(0.4, 0.6)),
            droop=rng.uniform(0.0, 0.6),
            fold=rng.uniform(-0.2, 0.3),
            curl=rng.uniform(-0.5, 0.1),
        )
        blades.append(place_blade(blade, petiole[-1], azimuth=azimuth, elevation=0.5 * elevation))
        petioles.append(make_tube("stem", petiole, radius=0.7, taper=0.8))
    return blades, petioles


# --- what is not a leaf


def grow_bud(tip: Floats, rng: np.random.Generator) -> list[Part]:
    """An upright bud at the tip (3,) of a stem: a tube that swells, and one that closes."""
    radius, length = rng.uniform(1.5, 5.0), rng.uniform(2.0, 3.5)
    points = tip + np.linspace(0, 1, 9)[:, None] * radius * length * np.array([*rng.normal(0, 0.2, 2), 1.0])
    swelling = make_tube("stem", points[:5], radius=0.4 * radius, taper=2.5)
    return [swelling, make_tube("stem", points[4:], radius=radius, taper=0.1)]


def grow_twig(stem: Floats, rng: np.random.Generator) -> Part:
    """A bare twig, or the stub of a petiole, that leaves a stem of (n, 3) points somewhere."""
    arc = Arc(
        azimuth=rng.uniform(0, 2 * np.pi),
        elevation=rng.uniform(0.2, 1.3),
        steps=np.full(8, math.exp(rng.uniform(math.log(5), math.log(120))) / 8),
        droop=rng.normal(0, 0.4),
        sweep=rng.normal(0, 0.4),
    )
    return make_tube("stem", arc_points(stem[rng.integers(1, len(stem))], arc), radius=rng.uniform(0.6, 2), taper=0.5)
