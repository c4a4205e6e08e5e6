"""Procedural plants whose leaves are meshes of known area, length and width.

A plant is grown from a family, a number of leaves and a seed. Shoots carry nodes (phyllotaxy with jitter), a node
carries fronds, and a frond is a petiole with one blade or a rachis with several leaflets. A blade is a grid mapped
through its midrib: an arc with droop, sweep and twist, and a folded, curled and rippled cross-section.

World units are millimetres, +z is up, the foot of the stem is at the origin and the soil at z = 0. Angles are radians
except in `Family`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvseg.errors import InputError
from mvseg.simulation.blades import (
    Blade,
    Floats,
    Ints,
    Leaf,
    arc_points,
    blade_faces,
    blade_uv,
    grid_faces,
    measure_leaf,
    place_blade,
)

Range = tuple[float, float]

MAX_LEAVES = 64
TUBE_SIDES = 8
ROUND = 48  # sides of what is round
GOLDEN_ANGLE = math.radians(137.50776)
POSES_TRIED = 8  # per frond; the least crowded one is kept, so that blades seldom cut through each other
CLEARANCE = 6.0  # mm; blades that come closer than this crowd each other


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh that is not a leaf: vertices (P, 3) float64 in mm, faces (F, 3) int32, material "stem" (petioles too),
    "pot", "soil", "ground" or "stake"."""

    material: str
    vertices: Floats
    faces: Ints


@dataclass(frozen=True, eq=False)
class Plant:
    """A grown plant: its leaves in the order of their ids 1..len(leaves), and everything else that a camera sees."""

    family: str
    leaves: tuple[Leaf, ...]
    parts: tuple[Part, ...]
    unit: str = "mm"


@dataclass(frozen=True)
class Family:
    """Ranges that the shapes of one family are drawn from. Lengths in mm, angles in degrees, the rest are ratios."""

    outline: tuple[float, float]  # (a, b): half-width ~ u^a (1-u)^b
    length: Range  # of a full-grown blade
    aspect: Range  # width / length
    petiole: Range  # petiole length / blade length
    elevation: Range  # of the petiole: youngest, oldest
    droop: Range  # bend of the midrib towards the ground from base to tip
    internode: Range
    divergence: float = 137.50776  # azimuth from node to node
    fold: Range = (5, 20)  # of each half blade, upwards
    curl: Range = (-35, 5)  # bend from midrib to edge
    twist: float = 15
    ripple: float = 0.05  # height of the waves of the edge / half-width
    per_node: int = 1  # fronds at a node, evenly around the stem
    per_shoot: int = 12  # fronds before a new shoot starts
    tillers: float = 0.0  # chance that further shoots come out of the soil and not out of the first one
    lean: Range = (2, 7)  # of a shoot at the soil, from the vertical
    lobes: tuple[int, float] = (0, 0.0)  # per side, and their depth / half-width
    teeth: float = 0.0  # depth of the serration / half-width
    leaflets: tuple[int, ...] = (1,)
    rows: int = 28  # vertices along a blade
    stem_radius: float = 2.2
    pot_radius: float = 52.0


FAMILIES: dict[str, Family] = {
    "ovate": Family((0.6, 0.85), (45, 75), (0.52, 0.68), (0.25, 0.45), (65, 15), (15, 60), (22, 38), 90.0,
                    curl=(-50, 0), per_node=2, teeth=0.03, tillers=0.3),
    "lanceolate": Family((0.75, 1.1), (75, 125), (0.20, 0.30), (0.08, 0.2), (75, 30), (20, 90), (12, 22),
                         curl=(-20, 10), fold=(10, 30), ripple=0.12, twist=25, per_shoot=16, tillers=0.3),
    "rosette": Family((1.2, 0.5), (30, 50), (0.5, 0.7), (0.55, 1.0), (80, 14), (0, 40), (0.3, 0.7),
                      curl=(-45, 10), per_shoot=64, stem_radius=1.8),
    "strap": Family((0.12, 0.7), (220, 420), (0.07, 0.11), (0.02, 0.03), (82, 58), (50, 150), (20, 36), 180.0,
                    fold=(5, 25), curl=(-15, 5), twist=35, ripple=0.3, per_shoot=9, tillers=1.0, rows=44,
                    stem_radius=6.0, pot_radius=85.0),
    "lobed": Family((0.55, 0.55), (60, 95), (0.65, 0.85), (0.4, 0.7), (70, 20), (10, 60), (16, 28),
                    curl=(-40, 5), per_shoot=10, lobes=(3, 0.62), teeth=0.04, rows=44, tillers=0.3),
    "compound": Family((0.6, 0.8), (36, 58), (0.48, 0.64), (0.6, 0.9), (70, 25), (5, 40), (26, 44),
                       per_shoot=6, leaflets=(3, 5, 5, 7), teeth=0.04, tillers=0.3),
    "leggy": Family((0.6, 0.85), (45, 90), (0.42, 0.64), (0.15, 0.5), (60, -10), (20, 80), (60, 140), 90.0,
                    curl=(-50, 0), per_node=2, per_shoot=4, tillers=0.8, lean=(0, 40)),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Node:
    """Where a frond sits on a stem: point (3,), azimuth, age from 0 (youngest) to 1, size factor."""

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


def grow_plant(family: str, num_leaves: int, seed: int) -> Plant:
    """Grow a plant; the same arguments give the same plant, bit for bit.

    Args:
        family: a key of `FAMILIES`.
        num_leaves: 1 to 64 instances; the leaflets of a compound leaf count one each.
        seed: >= 0.

    Returns:
        The plant with its pot (or a bed without one) and the ground; ids 1..num_leaves; millimetres.

    Raises:
        InputError: an unknown family, or a number of leaves or a seed out of range.
    """
    if family not in FAMILIES:
        raise InputError(f"unknown plant family '{family}', expected one of {', '.join(FAMILIES)}")
    if not 1 <= num_leaves <= MAX_LEAVES:
        raise InputError(f"{num_leaves} leaves asked for, expected 1 to {MAX_LEAVES}")
    if seed < 0:
        raise InputError(f"the seed is {seed}, expected 0 or more")
    kind = FAMILIES[family]
    rng = np.random.default_rng([seed, num_leaves, list(FAMILIES).index(family)])
    pot = draw_pot(kind, rng)
    counts = split_into_fronds(num_leaves, kind, rng)
    stems, nodes = grow_shoots(len(counts), kind, rng)
    fronds: list[Frond] = []
    for node, count in zip(nodes, counts, strict=True):
        fronds.append(place_frond(node, kind, count, pot, fronds, rng))
    faces, uv = blade_faces(kind.rows), blade_uv(kind.rows)
    blades = [blade for frond in fronds for blade in frond.blades]
    leaves = tuple(measure_leaf(index + 1, blade, faces, uv) for index, blade in enumerate(blades))
    tubes = [make_tube("stem", stem, kind.stem_radius, 0.5) for stem in stems]
    tubes += [make_tube("stem", frond.rachis, frond.radius, 0.7) for frond in fronds]
    if rng.random() < 0.2:
        foot = np.append(rng.uniform(-0.4, 0.4, 2) * kind.pot_radius, -1.0)
        top = foot + np.array([rng.normal(0, 10), rng.normal(0, 10), rng.uniform(60, 200)])
        tubes.append(make_tube("stake", np.linspace(foot, top, 8), rng.uniform(1.5, 4), 1.0))
    return Plant(family, leaves, (*tubes, *pot_parts(pot, rng)))


# --- fronds


def split_into_fronds(num_leaves: int, kind: Family, rng: np.random.Generator) -> list[int]:
    """How many blades each frond carries; they add up to `num_leaves`."""
    counts: list[int] = []
    most = max(3, num_leaves // 3)  # few leaflets make several small fronds rather than one
    while sum(counts) < num_leaves:
        counts.append(min(int(rng.choice(kind.leaflets)), most, num_leaves - sum(counts)))
    return counts


def draw_blade(kind: Family, age: float, scale: float, rng: np.random.Generator) -> Blade:
    """A blade of the family; young ones are smaller and more folded, old ones droop more."""
    length = scale * (0.4 + 0.6 * age) * rng.uniform(*kind.length)
    return Blade(
        length=length,
        width=length * rng.uniform(*kind.aspect),
        outline=(kind.outline[0] * rng.uniform(0.9, 1.1), kind.outline[1] * rng.uniform(0.9, 1.1)),
        droop=math.radians(rng.uniform(*kind.droop)) * (0.3 + 0.7 * age),
        sweep=math.radians(rng.normal(0, 10)),
        twist=math.radians(rng.normal(0, kind.twist)),
        roll=math.radians(rng.normal(0, 10)),
        fold=math.radians(rng.uniform(*kind.fold)) + 0.5 * (1 - age) ** 2,
        curl=math.radians(rng.uniform(*kind.curl)),
        ripple=kind.ripple * rng.uniform(0.3, 1.5),
        phase=rng.uniform(0, 2 * np.pi),
        lobes=(kind.lobes[0], kind.lobes[1] * rng.uniform(0.8, 1.1)),
        teeth=kind.teeth,
        rows=kind.rows,
    )


def grow_frond(node: Node, kind: Family, count: int, rng: np.random.Generator) -> Frond:
    """A frond in a random pose: a rachis with one blade at its end and count - 1 leaflets in pairs along it."""
    azimuth = node.azimuth + math.radians(rng.normal(0, 12))
    young, old = kind.elevation
    elevation = math.radians(young + (old - young) * node.age + rng.normal(0, 9))
    last = draw_blade(kind, node.age, node.scale, rng)
    pairs = math.ceil((count - 1) / 2)
    length = last.length * (rng.uniform(*kind.petiole) + 0.7 * pairs)
    bend = math.radians(rng.uniform(5, 25)) * (1 + 0.6 * pairs)
    rachis = arc_points(node.point, azimuth, elevation, np.full(10, length / 10), bend, 0.0)
    blades = [place_blade(last, rachis[-1], azimuth, elevation - bend)]
    for index in range(count - 1):
        place = 8.6 - 6.2 * (index // 2) / pairs
        aside = azimuth + math.radians(rng.normal(62, 6)) * (1 if index % 2 else -1)
        leaflet = draw_blade(kind, node.age, 0.85 * node.scale, rng)
        leaflet = replace(leaflet, roll=0.5 * leaflet.roll, droop=0.6 * leaflet.droop)
        base = np.array([np.interp(place, np.arange(11), rachis[:, axis]) for axis in range(3)])
        base += 0.04 * leaflet.length * np.array([math.cos(aside), math.sin(aside), 0.5])
        blades.append(place_blade(leaflet, base, aside, 0.5 * (elevation - bend) + rng.normal(0.1, 0.1)))
    return Frond(rachis, kind.stem_radius * 0.5 * node.scale * (0.5 + 0.5 * node.age), tuple(blades))


def place_frond(
    node: Node, kind: Family, count: int, pot: Pot, others: list[Frond], rng: np.random.Generator
) -> Frond:
    """The least crowded of a few random poses, lifted off the soil."""
    taken = cKDTree(np.concatenate([[[0.0, 0.0, -1e6]], *[blade[::2] for other in others for blade in other.blades]]))
    poses = []
    for _ in range(POSES_TRIED):
        frond = grow_frond(node, kind, count, rng)
        lifted = replace(frond, rachis=lift(pot, frond.rachis), blades=tuple(lift(pot, b) for b in frond.blades))
        points = np.concatenate([blade[::2] for blade in lifted.blades])
        near = taken.query(points, distance_upper_bound=CLEARANCE)[0]
        poses.append((float(np.isfinite(near).mean()), lifted))
    return min(poses, key=lambda pose: pose[0])[1]


# --- shoots


def grow_shoots(num_fronds: int, kind: Family, rng: np.random.Generator) -> tuple[list[Floats], list[Node]]:
    """Stems as (n, 3) points, and one node for every frond, shoot by shoot from the lowest to the top.

    Further shoots come out of the lower nodes of the first one (branches) or out of the soil around it (tillers).
    """
    parts = np.array_split(np.arange(num_fronds), math.ceil(num_fronds / kind.per_shoot))
    tillering = rng.random() < kind.tillers
    stems: list[Floats] = []
    nodes: list[Node] = []
    start = rng.uniform(0, 2 * np.pi)
    for index, part in enumerate(parts):
        azimuth = start + index * GOLDEN_ANGLE
        if index == 0 or tillering:
            out = rng.uniform(0.2, 0.45) * kind.pot_radius * (index > 0)
            foot = np.array([out * math.cos(azimuth), out * math.sin(azimuth), 0.0])
            tilt, scale = math.radians(rng.uniform(*kind.lean) + 6 * (index > 0)), rng.uniform(0.85, 1.1)
        else:
            parent = nodes[(2 * (index - 1)) % max(len(parts[0]) // 2, 1)]
            foot, azimuth = parent.point, parent.azimuth + rng.normal(0, 0.3)
            tilt, scale = math.radians(rng.uniform(35, 50)), rng.uniform(0.7, 0.85)
        stem, own = grow_shoot(Node(foot, azimuth, 1.0, scale), tilt, len(part), kind, rng)
        stems.append(stem)
        nodes += own
    return stems, nodes


def grow_shoot(
    foot: Node, tilt: float, num_fronds: int, kind: Family, rng: np.random.Generator
) -> tuple[Floats, list[Node]]:
    """One stem that leaves `foot` tilted from the vertical and turns upwards, and a node for each frond on it."""
    levels = math.ceil(num_fronds / kind.per_node)
    ages = ((levels - np.arange(levels)) / levels) ** 0.7
    gaps = foot.scale * rng.uniform(*kind.internode, levels) * (0.35 + 0.65 * ages)
    steps = np.repeat(gaps / 3, 3)
    stem = arc_points(foot.point, foot.azimuth, np.pi / 2 - tilt, steps, -0.7 * tilt, rng.normal(0, 0.3))
    turn = foot.azimuth + rng.uniform(0, 2 * np.pi)
    nodes = []
    for index in range(num_fronds):
        level, place = divmod(index, kind.per_node)
        azimuth = turn + math.radians(kind.divergence * level + 360 * place / kind.per_node)
        nodes.append(Node(stem[3 * level + 3], azimuth, float(ages[level]), foot.scale))
    return stem, nodes


# --- tubes, pot and ground


def ring_faces(num_rings: int, sides: int) -> Ints:
    """(F, 3) faces between closed rings of vertices that follow each other."""
    grid = np.arange(num_rings * sides).reshape(num_rings, sides)
    return grid_faces(np.concatenate([grid, grid[:, :1]], 1)).astype(np.int32)


def make_tube(material: str, points: Floats, radius: float, taper: float) -> Part:
    """A tube around (n, 3) points whose radius goes from `radius` to `radius * taper`."""
    along = np.gradient(points, axis=0)
    least = np.eye(3)[np.argmin(np.abs(along).max(0))]  # the axis that the tube runs along least
    first = np.cross(along, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first) / np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, TUBE_SIDES, endpoint=False)[:, None]
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    vertices = points[:, None] + radius * np.linspace(1, taper, len(points))[:, None, None] * ring
    return Part(material, vertices.reshape(-1, 3), ring_faces(len(points), TUBE_SIDES))


def revolve(material: str, profile: list[tuple[float, float]], sides: int, bumps: Floats | float = 0.0) -> Part:
    """The surface that a profile of (radius, z) pairs sweeps around the z axis; `bumps` (rings, sides) adds to z."""
    radius, z = np.array(profile).T[:, :, None]
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    grid = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle) + z + bumps], -1)
    return Part(material, grid.reshape(-1, 3), ring_faces(len(profile), sides))


@dataclass(frozen=True)
class Pot:
    """A pot, its soil at z = 0 and the ground at z = -height; height 0 is a bed without a pot."""

    radius: float
    height: float
    sides: int


def draw_pot(kind: Family, rng: np.random.Generator) -> Pot:
    """A round or square pot, or a bed."""
    radius = kind.pot_radius * rng.uniform(0.85, 1.2)
    return Pot(radius, radius * rng.uniform(1.1, 1.8) * (rng.random() > 0.2), 4 if rng.random() < 0.2 else ROUND)


def lift(pot: Pot, points: Floats) -> Floats:
    """The points (P, 3) with those below the soil, the rim or the ground lifted smoothly above it."""
    outside = np.clip((np.linalg.norm(points[:, :2], axis=1) - pot.radius - 6) / 40, 0, 1)
    floor = 4 - pot.height * outside**2 * (3 - 2 * outside)
    z = floor + 2 * np.logaddexp(0, (points[:, 2] - floor) / 2)
    return np.concatenate([points[:, :2], z[:, None]], 1)


def pot_parts(pot: Pot, rng: np.random.Generator) -> list[Part]:
    """The pot, its soil and the ground as meshes."""
    wide = [(0.5 * 1.35**ring, -pot.height) for ring in range(rng.integers(21, 32))]
    if not pot.height:
        return [revolve("soil", wide, ROUND, rng.normal(-1, 0.8, (len(wide), ROUND)))]
    wall = [(0.75, -pot.height), (1.0, -14.0), (1.06, -14.0), (1.06, 2.0), (0.99, 2.0), (0.99, -8.0)]
    soil = [(0.5 + (pot.radius - 0.5) * ring / 12, -1.0) for ring in range(13)]
    return [
        revolve("pot", [(pot.radius * ratio, z) for ratio, z in wall], pot.sides),
        revolve("soil", soil, pot.sides, rng.normal(0, 1.2, (len(soil), pot.sides))),
        revolve("ground", wide, ROUND),
    ]
