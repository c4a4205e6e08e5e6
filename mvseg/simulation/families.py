"""Plant families: the ranges that shapes are drawn from. Lengths in mm, angles in degrees, the rest are ratios."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mvseg.simulation.blades import Blade

Range = tuple[float, float]


@dataclass(frozen=True)
class Family:
    """Traits that plants of one family have in common."""

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
    leaflets: tuple[int, ...] = (1,)  # of a frond; drawn from these
    has_parallel_veins: bool = False
    rows: int = 28  # vertices along a blade
    stem_radius: float = 2.2
    pot_radius: float = 52.0


FAMILIES: dict[str, Family] = {
    "ovate": Family(
        outline=(0.6, 0.85), length=(45, 75), aspect=(0.52, 0.68), curl=(-50, 0), teeth=0.03,
        petiole=(0.25, 0.45), elevation=(65, 15), droop=(15, 60),
        internode=(22, 38), divergence=90.0, per_node=2, tillers=0.3,
    ),
    "lanceolate": Family(
        outline=(0.75, 1.1), length=(75, 125), aspect=(0.20, 0.30), curl=(-20, 10), fold=(10, 30), ripple=0.12,
        twist=25, petiole=(0.08, 0.2), elevation=(75, 30), droop=(20, 90),
        internode=(12, 22), per_shoot=16, tillers=0.3,
    ),
    "rosette": Family(
        outline=(1.2, 0.5), length=(30, 50), aspect=(0.5, 0.7), curl=(-45, 10),
        petiole=(0.55, 1.0), elevation=(80, 14), droop=(0, 40),
        internode=(0.3, 0.7), per_shoot=64, stem_radius=1.8,
    ),
    "strap": Family(
        outline=(0.12, 0.7), length=(220, 420), aspect=(0.07, 0.11), curl=(-15, 5), fold=(5, 25), ripple=0.3, twist=35,
        petiole=(0.02, 0.03), elevation=(82, 58), droop=(50, 150), has_parallel_veins=True, rows=44,
        internode=(20, 36), divergence=180.0, per_shoot=9, tillers=1.0, stem_radius=6.0, pot_radius=85.0,
    ),
    "lobed": Family(
        outline=(0.55, 0.55), length=(60, 95), aspect=(0.65, 0.85), curl=(-40, 5), lobes=(3, 0.62), teeth=0.04,
        petiole=(0.4, 0.7), elevation=(70, 20), droop=(10, 60), rows=44,
        internode=(16, 28), per_shoot=10, tillers=0.3,
    ),
    "compound": Family(
        outline=(0.6, 0.8), length=(36, 58), aspect=(0.48, 0.64), leaflets=(3, 5, 5, 7), teeth=0.04,
        petiole=(0.6, 0.9), elevation=(70, 25), droop=(5, 40),
        internode=(26, 44), per_shoot=6, tillers=0.3,
    ),
    "leggy": Family(
        outline=(0.6, 0.85), length=(45, 90), aspect=(0.42, 0.64), curl=(-50, 0),
        petiole=(0.15, 0.5), elevation=(60, -10), droop=(20, 80),
        internode=(60, 140), divergence=90.0, per_node=2, per_shoot=4, tillers=0.8, lean=(0, 40),
    ),
    "fern": Family(
        outline=(0.35, 0.55), length=(180, 360), aspect=(0.2, 0.38), curl=(-25, 5), lobes=(18, 0.85), twist=25,
        petiole=(0.03, 0.3), elevation=(84, 15), droop=(20, 110), fold=(0, 20), rows=100,
        internode=(0.3, 1.2), per_shoot=48, stem_radius=6.0, pot_radius=70.0,
    ),
}  # fmt: skip


def draw_blade(family: Family, rng: np.random.Generator, *, age: float, scale: float) -> Blade:
    """A blade of the family; young ones (age 0) are smaller and more folded, full-grown ones (age 1) droop more."""
    length = scale * (0.4 + 0.6 * age) * rng.uniform(*family.length)
    return Blade(
        length=length,
        width=length * rng.uniform(*family.aspect),
        outline=(family.outline[0] * rng.uniform(0.9, 1.1), family.outline[1] * rng.uniform(0.9, 1.1)),
        droop=math.radians(rng.uniform(*family.droop)) * (0.3 + 0.7 * age),
        sweep=math.radians(rng.normal(0, 10)),
        twist=math.radians(rng.normal(0, family.twist)),
        roll=math.radians(rng.normal(0, 10)),
        fold=math.radians(rng.uniform(*family.fold)) + 0.5 * (1 - age) ** 2,
        curl=math.radians(rng.uniform(*family.curl)),
        ripple=family.ripple * rng.uniform(0.3, 1.5),
        phase=rng.uniform(0, 2 * np.pi),
        lobes=(family.lobes[0], family.lobes[1] * rng.uniform(0.8, 1.1)),
        teeth=family.teeth,
        rows=family.rows,
    )
