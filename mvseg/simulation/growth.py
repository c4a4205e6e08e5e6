"""Procedural plants whose leaves are meshes of known area, length and width.

A plant is grown from a family, a number of leaves and a seed. Shoots carry nodes (phyllotaxy with jitter), a node
carries fronds, and a frond is a petiole with one blade or a rachis with several leaflets. World units are millimetres,
+z is up, the foot of the stem is at the origin and the soil at z = 0. Angles are radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvseg.arrays import Floats
from mvseg.simulation.blades import Arc, Leaf, arc_points, leaf_from_blade, place_blade
from mvseg.simulation.families import FAMILIES, Family, draw_blade
from mvseg.simulation.pot import Part, Pot, draw_pot, lift, make_tube, pot_parts

GOLDEN_ANGLE = math.radians(137.50776)
POSES_TRIED = 8  # limit: per frond; the least crowded one is kept, so that blades seldom cut through each other
CLEARANCE = 6.0  # chosen: mm; blades that come closer than this crowd each other
FAR_AWAY = np.array([[0.0, 0.0, -1e6]])  # a point that crowds nothing


@dataclass(frozen=True, eq=False)
class SimulatedPlant:
    """A grown plant: its leaves in the order of their ids 1..len(leaves), and everything else that a camera sees.

    Attributes:
        family: a key of `FAMILIES`.
        leaves, parts: meshes; the first `len(stems)` parts are the stems.
        stems: (n, 3) points of each stem, from the foot to the tip, mm.
        petioles: (n, 3) points of the petiole of each leaf, or of its leaflet's rachis, from its node on the stem, mm;
            () where they are not known.
        is_wild: see `wild.make_wild`; its surroundings are those of homes and gardens, too.
    """

    family: str
    leaves: tuple[Leaf, ...]
    parts: tuple[Part, ...]
    stems: tuple[Floats, ...] = ()
    petioles: tuple[Floats, ...] = ()
    is_wild: bool = False


@dataclass(frozen=True, eq=False)
class StemNode:
    """Place of a frond on a stem: point (3,), azimuth, age from 0 (youngest) to 1, size factor."""

    point: Floats
    azimuth: float
    age: float
    scale: float


@dataclass(frozen=True, eq=False)
class Frond:
    """A petiole or rachis of (n, 3) points with the vertices (P, 3) of each of its blades."""

    rachis: Floats
    radius: float
    blades: tuple[Floats, ...]

    @property
    def points(self) -> Floats:
        """Every second vertex of the blades."""
        return np.concatenate([blade[::2] for blade in self.blades])


def grow_plant(family: str, num_leaves: int, seed: int) -> SimulatedPlant:
    """Grow a plant, in mm, with pot or bed and the ground; the same arguments give the same plant, bit for bit. It has
    1 to 64 leaves, ids from 1 on; the leaflets of a compound leaf count one each."""
    ranges = FAMILIES[family]
    rng = np.random.default_rng([seed, num_leaves, list(FAMILIES).index(family)])
    pot = draw_pot(ranges, rng)
    blade_counts = split_into_fronds(num_leaves, ranges, rng)
    stems, nodes = grow_shoots(len(blade_counts), ranges, rng)
    fronds: list[Frond] = []
    for node, num_blades in zip(nodes, blade_counts, strict=True):
        taken = cKDTree(np.concatenate([FAR_AWAY, *(frond.points for frond in fronds)]))
        poses = [lift_frond(grow_frond(node, ranges, rng, num_blades=num_blades), pot) for _ in range(POSES_TRIED)]
        fronds.append(min(poses, key=lambda frond: crowding(frond, taken)))
    blades = [blade for frond in fronds for blade in frond.blades]
    leaves = tuple(leaf_from_blade(index + 1, blade) for index, blade in enumerate(blades))
    tubes = [make_tube("stem", stem, radius=ranges.stem_radius, taper=0.5) for stem in stems]
    tubes += [make_tube("stem", frond.rachis, radius=frond.radius, taper=0.7) for frond in fronds]
    if rng.random() < 0.2:
        foot = np.append(rng.uniform(-0.4, 0.4, 2) * ranges.pot_radius, -1.0)
        top = foot + np.array([rng.normal(0, 10), rng.normal(0, 10), rng.uniform(60, 200)])
        tubes.append(make_tube("stake", np.linspace(foot, top, 8), radius=rng.uniform(1.5, 4), taper=1.0))
    petioles = tuple(frond.rachis for frond in fronds for _ in frond.blades)
    parts = (*tubes, *pot_parts(pot, rng))
    return SimulatedPlant(family=family, leaves=leaves, parts=parts, stems=tuple(stems), petioles=petioles)


# --- fronds


def split_into_fronds(num_leaves: int, family: Family, rng: np.random.Generator) -> list[int]:
    """How many blades each frond carries; they add up to `num_leaves`."""
    counts: list[int] = []
    most = max(3, num_leaves // 3)  # few leaflets make several small fronds rather than one
    while sum(counts) < num_leaves:
        counts.append(min(int(rng.choice(family.leaflets)), most, num_leaves - sum(counts)))
    return counts


def crowding(frond: Frond, taken: cKDTree) -> float:
    """Share of the frond's points that are close to others."""
    return float(np.isfinite(taken.query(frond.points, distance_upper_bound=CLEARANCE)[0]).mean())


def lift_frond(frond: Frond, pot: Pot) -> Frond:
    """The frond off the soil, see `pot.lift`."""
    return replace(frond, rachis=lift(pot, frond.rachis), blades=tuple(lift(pot, blade) for blade in frond.blades))


def grow_frond(node: StemNode, family: Family, rng: np.random.Generator, *, num_blades: int) -> Frond:
    """A frond in a random pose: a rachis with one blade at its end and the others, leaflets, in pairs along it."""
    azimuth = node.azimuth + math.radians(rng.normal(0, 12))
    young, old = family.elevation
    elevation = math.radians(young + (old - young) * node.age + rng.normal(0, 9))
    last = draw_blade(family, rng, age=node.age, scale=node.scale)
    pairs = math.ceil((num_blades - 1) / 2)
    length = last.length * (rng.uniform(*family.petiole) + 0.7 * pairs)
    bend = math.radians(rng.uniform(5, 25)) * (1 + 0.6 * pairs)
    arc = Arc(azimuth=azimuth, elevation=elevation, steps=np.full(10, length / 10), droop=bend)
    rachis = arc_points(node.point, arc)
    blades = [place_blade(last, rachis[-1], azimuth=azimuth, elevation=elevation - bend)]
    for index in range(num_blades - 1):
        position = 8.6 - 6.2 * (index // 2) / pairs  # along the ten pieces of the rachis
        aside = azimuth + math.radians(rng.normal(62, 6)) * (1 if index % 2 else -1)
        leaflet = draw_blade(family, rng, age=node.age, scale=0.85 * node.scale)
        leaflet = replace(leaflet, roll=0.5 * leaflet.roll, droop=0.6 * leaflet.droop)
        base = np.array([np.interp(position, np.arange(11), rachis[:, axis]) for axis in range(3)])
        base += 0.04 * leaflet.length * np.array([math.cos(aside), math.sin(aside), 0.5])
        slope = 0.5 * (elevation - bend) + rng.normal(0.1, 0.1)
        blades.append(place_blade(leaflet, base, azimuth=aside, elevation=slope))
    return Frond(rachis, family.stem_radius * 0.5 * node.scale * (0.5 + 0.5 * node.age), tuple(blades))


# --- shoots


def grow_shoots(num_fronds: int, family: Family, rng: np.random.Generator) -> tuple[list[Floats], list[StemNode]]:
    """Stems as (n, 3) points, and one node for every frond, shoot by shoot from the lowest to the top. Further shoots
    come out of the lower nodes of the first one (branches) or out of the soil around it (tillers)."""
    shares = np.array_split(np.arange(num_fronds), math.ceil(num_fronds / family.per_shoot))
    is_tillering = rng.random() < family.tillers
    stems: list[Floats] = []
    nodes: list[StemNode] = []
    start = rng.uniform(0, 2 * np.pi)
    for index, share in enumerate(shares):
        azimuth = start + index * GOLDEN_ANGLE
        if index == 0 or is_tillering:
            foot, tilt = place_foot(family, rng, azimuth=azimuth, is_first=index == 0)
        else:
            parent = nodes[(2 * (index - 1)) % max(len(shares[0]) // 2, 1)]
            azimuth, tilt = parent.azimuth + rng.normal(0, 0.3), math.radians(rng.uniform(35, 50))
            foot = StemNode(point=parent.point, azimuth=azimuth, age=1.0, scale=rng.uniform(0.7, 0.85))
        stem, shoot_nodes = grow_shoot(foot, family, rng, tilt=tilt, num_fronds=len(share))
        stems.append(stem)
        nodes += shoot_nodes
    return stems, nodes


def place_foot(family: Family, rng: np.random.Generator, *, azimuth: float, is_first: bool) -> tuple[StemNode, float]:
    """Place and tilt of a shoot, the first one in the middle."""
    out = rng.uniform(0.2, 0.45) * family.pot_radius * (not is_first)
    point = np.array([out * math.cos(azimuth), out * math.sin(azimuth), 0.0])
    tilt = math.radians(rng.uniform(*family.lean) + 6 * (not is_first))
    return StemNode(point=point, azimuth=azimuth, age=1.0, scale=rng.uniform(0.85, 1.1)), tilt


def grow_shoot(
    foot: StemNode, family: Family, rng: np.random.Generator, *, tilt: float, num_fronds: int
) -> tuple[Floats, list[StemNode]]:
    """One stem that leaves `foot` tilted from the vertical and turns upwards, and a node for each frond on it."""
    levels = math.ceil(num_fronds / family.per_node)
    ages = ((levels - np.arange(levels)) / levels) ** 0.7
    gaps = foot.scale * rng.uniform(*family.internode, levels) * (0.35 + 0.65 * ages)
    steps = np.repeat(gaps / 3, 3)
    sweep = rng.normal(0, 0.3)
    arc = Arc(azimuth=foot.azimuth, elevation=np.pi / 2 - tilt, steps=steps, droop=-0.7 * tilt, sweep=sweep)
    stem = arc_points(foot.point, arc)
    turn = foot.azimuth + rng.uniform(0, 2 * np.pi)
    nodes = []
    for index in range(num_fronds):
        level, at_level = divmod(index, family.per_node)
        azimuth = turn + math.radians(family.divergence * level + 360 * at_level / family.per_node)
        nodes.append(StemNode(point=stem[3 * level + 3], azimuth=azimuth, age=float(ages[level]), scale=foot.scale))
    return stem, nodes
