"""One plant over days: the same leaves with the same ids on every date, with truth over time.

Leaves unfold at the apex, grow, droop with age, yellow, hang and fall; on some dates the plant wilts. Its pot is
turned, shifted and set down a little askew from date to date, and the cameras are others from one date on. World units
are millimetres, +z is up, times are days.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mvseg.arrays import Floats
from mvseg.errors import InputError
from mvseg.formats.text_file import write_table
from mvseg.scene import Cameras
from mvseg.simulation.blades import Arc, Leaf, arc_points, leaf_from_blade
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.families import FAMILIES, Family
from mvseg.simulation.growth import (
    FAR_AWAY,
    GOLDEN_ANGLE,
    POSES_TRIED,
    Frond,
    SimulatedPlant,
    StemNode,
    crowding,
    grow_frond,
    lift_frond,
    place_foot,
    split_into_fronds,
)  # fmt: skip
from mvseg.simulation.pot import Part, Pot, draw_pot, make_tube, pot_parts
from mvseg.simulation.scene_writer import write_scene
from mvseg.simulation.wild import hang, roll_up
from mvseg.system.atomic import folder_whole

SERIES_FILE, TRUTH_FILE = "series.csv", "truth.csv"
NUM_DATES = 8  # chosen: of the specs that are drawn
EXPANSION = 14.0  # chosen: days from a leaf's first sight to its full size
FIRST_SIZE = 0.15  # chosen: share of its full length at which a leaf is first seen
YELLOWING = 6.0  # chosen: days from the first yellow to the fall
WILT = 24.0  # chosen: degrees that petioles sink by, and blades bend more, on a date of wilting


@dataclass(frozen=True)
class SeriesSpec:
    """One plant over days.

    Attributes:
        family: a key of `FAMILIES`.
        leaves: how many are there on the first date, and how many appear until the last, at least 1 and 0.
        times: days, rising.
        seed: >= 0.
        falls: share of the leaves of the first date that fall in between.
        wilts: index of the date on which the plant is wilted, None for none.
        turns: is the pot turned, shifted and set down askew between dates?
        num_views: cameras around the plant before and after the rig is changed, halfway.
        size: image width and height in pixels.
    """

    name: str
    family: str
    leaves: tuple[int, int]
    times: tuple[float, ...]
    seed: int
    falls: float = 0.2
    wilts: int | None = None
    turns: bool = True
    num_views: tuple[int, int] = (10, 12)
    size: tuple[int, int] = (480, 480)


@dataclass(frozen=True)
class PotPlace:
    """Place of the pot on one date: turned by `turn` degrees about up, tilted by `lean` degrees towards azimuth
    `towards`, then shifted by (x, y) mm."""

    turn: float = 0.0
    lean: float = 0.0
    towards: float = 0.0
    x: float = 0.0
    y: float = 0.0

    def place(self, points: Floats) -> Floats:
        """Points (P, 3) of the plant in the world of this date."""
        axis = np.array([-math.sin(math.radians(self.towards)), math.cos(math.radians(self.towards)), 0.0])
        turn = Rotation.from_euler("z", self.turn, degrees=True)
        placed: Floats = (Rotation.from_rotvec(math.radians(self.lean) * axis) * turn).apply(points)
        return placed + (self.x, self.y, 0.0)


@dataclass(frozen=True)
class _Seat:
    """Shoot, level and ids of a frond, and the days after the first date of its first sight and of its first yellow."""

    shoot: int
    level: int
    ids: tuple[int, ...]
    born: float
    yellows: float
    azimuth: float
    scale: float
    seed: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class GrowingPlant:
    """A plant at all times: `at` gives it on a day after the first date. The same spec gives the same plant."""

    spec: SeriesSpec
    pot: Pot
    shoots: tuple[tuple[StemNode, Floats, float], ...]  # foot, (levels,) full gaps, tilt
    seats: tuple[_Seat, ...]

    def at(self, day: float, *, is_wilted: bool = False) -> SimulatedPlant:
        """The plant as it is on a day, its pot straight at the origin; the leaves that are there, with their ids."""
        family = FAMILIES[self.spec.family]
        if is_wilted:
            (young, old), (least, most) = family.elevation, family.droop
            low = (max(young - WILT, 5.0), max(old - WILT, 5.0))
            family = replace(family, elevation=low, droop=(least + WILT / 2, most + WILT / 2))
        leaves: list[Leaf] = []
        stems = [self._stem(index, day) for index in range(len(self.shoots))]
        tubes = [make_tube("stem", stem, radius=family.stem_radius, taper=0.5) for stem in stems]
        for seat in self.seats:
            if day < seat.born or day > seat.yellows + YELLOWING:
                continue
            frond = self._frond(seat, day, stems[seat.shoot], family)
            tubes.append(make_tube("stem", frond.rachis, radius=frond.radius, taper=0.7))
            for number, blade in zip(seat.ids, frond.blades, strict=True):
                leaves.append(_age(leaf_from_blade(number, blade), (day - seat.yellows) / YELLOWING))
        parts = (*tubes, *pot_parts(self.pot, np.random.default_rng([self.spec.seed, 1])))
        return SimulatedPlant(family=self.spec.family, leaves=tuple(leaves), parts=parts, stems=tuple(stems))

    def _stem(self, index: int, day: float) -> Floats:
        foot, gaps, tilt = self.shoots[index]
        borns = [min(s.born for s in self.seats if (s.shoot, s.level) == (index, level)) for level in range(len(gaps))]
        grown = gaps * np.array([_size(day - born + 0.3 * EXPANSION) for born in borns])
        arc = Arc(foot.azimuth, np.pi / 2 - tilt, steps=np.repeat(np.maximum(grown, 0.05) / 3, 3), droop=-0.7 * tilt)
        return arc_points(foot.point, arc)

    def _frond(self, seat: _Seat, day: float, stem: Floats, family: Family) -> Frond:
        size = _size(day - seat.born)
        sway = np.random.default_rng([*seat.seed, 7]).normal(0, 1, 2)  # leaves move a little from day to day
        azimuth = seat.azimuth + math.radians(4) * math.sin(2 * day + 3 * sway[0])
        age = float(np.clip(size + 0.05 * math.sin(3 * day + 3 * sway[1]), 0, 1))
        scale = seat.scale * size / (0.4 + 0.6 * age)
        node = StemNode(point=stem[3 * seat.level + 3], azimuth=azimuth, age=age, scale=scale)
        frond = grow_frond(node, family, np.random.default_rng(seat.seed), num_blades=len(seat.ids))
        return lift_frond(frond, self.pot)


def plan_plant(spec: SeriesSpec) -> GrowingPlant:
    """Draw everything about a plant but the day."""
    family, rng = FAMILIES[spec.family], np.random.default_rng([spec.seed, *spec.family.encode()])
    pot, total = draw_pot(family, rng), sum(spec.leaves)
    counts = split_into_fronds(total, family, rng)
    num_shoots = math.ceil(len(counts) / family.per_shoot)
    shoots, start = [], rng.uniform(0, 2 * np.pi)
    for index, share in enumerate(np.array_split(counts, num_shoots)):
        foot, tilt = place_foot(family, rng, azimuth=start + index * GOLDEN_ANGLE, is_first=index == 0)
        levels = math.ceil(len(share) / family.per_node)
        shoots.append((foot, foot.scale * rng.uniform(*family.internode, levels), tilt))
    return _uncrowd(GrowingPlant(spec, pot, tuple(shoots), tuple(_seat_fronds(spec, counts, shoots, rng))))


def _seat_fronds(
    spec: SeriesSpec, counts: Sequence[int], shoots: Sequence[tuple[StemNode, Floats, float]], rng: np.random.Generator
) -> list[_Seat]:
    family = FAMILIES[spec.family]
    span = spec.times[-1] - spec.times[0]
    turns = [rng.uniform(0, 2 * np.pi) for _ in shoots]
    share_of = [len(share) for share in np.array_split(counts, len(shoots))]
    slots = [(n // family.per_node, shoot, n % family.per_node) for shoot, k in enumerate(share_of) for n in range(k)]
    slots.sort(key=lambda slot: (slot[0] / (share_of[slot[1]] or 1), slot))
    num_old = int(np.searchsorted(np.cumsum(counts), spec.leaves[0])) + 1
    gap = span / max(len(counts) - num_old, 1)
    pace = gap if len(counts) > num_old else EXPANSION / 4
    seats, first_id = [], 1
    for rank, ((level, shoot, place), count) in enumerate(zip(slots, counts, strict=True)):
        born = (rank - num_old + rng.uniform(0.1, 0.9)) * (gap if rank >= num_old else min(pace, EXPANSION / 4))
        falls = rank < num_old and rng.random() < spec.falls * 2 * (1 - rank / num_old)
        yellows = rng.uniform(-0.5 * YELLOWING, max(span - YELLOWING, 0.1)) if falls else math.inf
        azimuth = turns[shoot] + math.radians(family.divergence * level + 360 * place / family.per_node)
        scale, ids = shoots[shoot][0].scale * rng.uniform(0.8, 1.1), tuple(range(first_id, first_id + count))
        seats.append(_Seat(shoot, level, ids, born, yellows, azimuth, scale, seed=(spec.seed, rank, 0)))
        first_id += count
    return seats


def _uncrowd(plant: GrowingPlant) -> GrowingPlant:
    seats, day = list(plant.seats), plant.spec.times[-1] - plant.spec.times[0] + EXPANSION
    taken = FAR_AWAY
    for index, seat in enumerate(seats):
        stem, tree = plant._stem(seat.shoot, day), cKDTree(taken)
        others = [replace(seat, seed=(*seat.seed[:2], attempt)) for attempt in range(POSES_TRIED)]
        tried = [(other, plant._frond(other, day, stem, FAMILIES[plant.spec.family])) for other in others]
        seats[index], frond = min(tried, key=lambda pose: crowding(pose[1], tree))
        taken = np.concatenate([taken, frond.points])
    return replace(plant, seats=tuple(seats))


def _size(age: float) -> float:
    middle, steep = 0.45 * EXPANSION, 0.11 * EXPANSION
    return FIRST_SIZE + (1 - FIRST_SIZE) / (1 + math.exp(-np.clip((age - middle) / steep, -50, 50)))


def _age(leaf: Leaf, share: float) -> Leaf:
    """The leaf after a share of its yellowing: it dries, rolls up a little and hangs; unchanged below 0."""
    if share <= 0:
        return leaf
    rolled = roll_up(leaf.vertices, 1.2 * share)
    return replace(leaf_from_blade(leaf.leaf_id, hang(rolled, 0.9 * share)), dryness=min(share, 1.0))


def draw_pots(spec: SeriesSpec) -> list[PotPlace]:
    """How the pot stands on each date."""
    rng = np.random.default_rng([spec.seed, 2])
    pots = [PotPlace()]
    for _ in spec.times[1:]:
        x, y = rng.normal(0, 80, 2).tolist()
        lean = min(abs(rng.normal(0, 4)), 15.0)
        pots.append(PotPlace(rng.uniform(0, 360), lean, rng.uniform(0, 360), x, y) if spec.turns else PotPlace())
    return pots


def move_plant(plant: SimulatedPlant, pot: PotPlace) -> SimulatedPlant:
    """The plant, its pot and the soil where the pot stands."""

    def moved(part: Part) -> Part:
        return part if part.material == "ground" else replace(part, vertices=pot.place(part.vertices))

    leaves = tuple(replace(leaf, vertices=pot.place(leaf.vertices)) for leaf in plant.leaves)
    stems = tuple(pot.place(stem) for stem in plant.stems)
    return replace(plant, leaves=leaves, parts=tuple(moved(part) for part in plant.parts), stems=stems)


def grow_series(spec: SeriesSpec) -> list[SimulatedPlant]:
    """The plant on every date, where its pot stands; a leaf has the same id on all dates. Raises InputError: on a date
    no leaf is left."""
    growing, plants = plan_plant(spec), []
    for index, (time, pot) in enumerate(zip(spec.times, draw_pots(spec), strict=True)):
        plant = growing.at(time - spec.times[0], is_wilted=index == spec.wilts)
        if not plant.leaves:
            raise InputError(f"{spec.name}: no leaf is left on day {time:g}, expected fewer falls")
        plants.append(move_plant(plant, pot))
    return plants


def series_cameras(spec: SeriesSpec, index: int, plant: SimulatedPlant) -> Cameras:
    """Cameras around the plant on a date; from the middle of the series on another rig."""
    is_late = 2 * index >= len(spec.times)
    heights = (10.0, 40.0, 70.0) if is_late else (20.0, 50.0)
    width, height = spec.size
    return arc_cameras(
        spec.num_views[is_late], plant, span_deg=360, start_deg=17.0 * is_late, elevations_deg=heights,
        width=width, height=height,
    )  # fmt: skip


def write_series(folder: Path, specs: Sequence[SeriesSpec]) -> None:
    """Write the scenes of plants over days, and two tables; the folder appears whole or not at all.

    Every scene is one of `write_scene`; its truth has the same number for the same leaf on all dates. `series.csv` is a
    table for `mvseg batch` (scene, name, plant, time), and `truth.csv` has one row per leaf and date (area, length,
    width, dryness). Raises InputError: the folder exists.
    """
    if folder.exists():
        raise InputError(f"{folder} exists already, expected a new folder for the series")
    scenes, truth = [], []
    with folder_whole(folder) as partial:
        for spec in specs:
            for index, plant in enumerate(grow_series(spec)):
                name, time = f"{spec.name}_{index:02d}", f"{spec.times[index]:g}"
                write_scene(partial / name, plant, series_cameras(spec, index, plant), seed=spec.seed)
                scenes.append((name, name, spec.name, time))
                for leaf in plant.leaves:
                    numbers = (leaf.area, leaf.length, leaf.width, leaf.dryness)
                    truth.append((spec.name, time, name, leaf.leaf_id, *numbers))
        write_table(partial / SERIES_FILE, ["scene", "name", "plant", "time"], scenes)
        columns = ["plant", "time", "scene", "leaf", "area", "length", "width", "dryness"]
        write_table(partial / TRUTH_FILE, columns, truth)


def draw_specs(num_plants: int, *, seed: int = 0) -> list[SeriesSpec]:
    """Plants of all families in turn, of 12 to 30 leaves, seen every one to three days; one in two wilts once."""
    families, specs = ("ovate", "lanceolate", "strap", "lobed", "compound", "rosette"), []
    for index in range(num_plants):
        rng = np.random.default_rng([seed, index, 3])
        first, new = int(rng.integers(9, 20)), int(rng.integers(3, 11))
        times = tuple(np.round(np.cumsum(rng.uniform(1, 3, NUM_DATES)) - 1, 1).tolist())
        family, own_seed = families[index % len(families)], int(rng.integers(1 << 30))
        name, wilts = f"{family}-{index:02d}", int(rng.integers(1, NUM_DATES)) if rng.random() < 0.5 else None
        specs.append(SeriesSpec(name, family, leaves=(first, new), times=times, seed=own_seed, wilts=wilts))
    return specs
