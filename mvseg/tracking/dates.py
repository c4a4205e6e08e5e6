"""Input of tracking: one plant on one date, from a result folder or from a `Result` in memory."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mvseg.arrays import Floats
from mvseg.errors import InputError, collect_warnings
from mvseg.reconstruction.shapes import best_shape
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface, cell_normals
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.results.plant_graph import KINDS, OF_NODES
from mvseg.results.read import find_result, load_result
from mvseg.results.result import Result
from mvseg.tracking.numbers import OBSERVATIONS
from mvseg.tracking.pictures import LeafPicture, draw_pictures
from mvseg.traits.leaf import Measurement
from mvseg.traits.ontology import unit_of
from mvseg.traits.up import level_frame

NUMBER = re.compile(r"[+-]?(0|[1-9]\d*|(?=\.\d))(\.\d*)?([eE][+-]?\d+)?")  # 0428 and 2026_04_28 are none
UNITS = {"m": 1000.0, "cm": 10.0, "mm": 1.0}  # in millimetres (a definition)


@dataclass(frozen=True)
class Number:
    """A trait: its value, its standard deviation (NaN where there is none) and its unit."""

    value: float
    sd: float
    unit: str


Numbers = Mapping[str, Number]  # by trait


@dataclass(frozen=True, eq=False)
class SeenLeaf:
    """One leaf on one date.

    Attributes:
        midrib: (stations, 3) float64 from base to tip, evenly spread, in the date's frame: its unit, +z up where up is
            known; None for a leaf without a shape (seen in one view).
        normal: (3,) unit mean normal of the blade; None with the midrib.
        points: (cloud, 3) points of the leaf: of a surface, rows from base to tip of edge, midrib, edge; None with the
            midrib.
        is_oriented: the first point of the midrib is known to be the base.
        is_doubted: it looks like a stem, as rolled leaves of seedlings do: it counts if another date shows the leaf.
        node, node_place: numbers of its stem and of its node, and (3,) where that is; None: not known to sit on one.
    """

    leaf: int
    midrib: Floats | None
    normal: Floats | None
    points: Floats | None
    is_oriented: bool
    numbers: Numbers
    is_doubted: bool = False
    node: tuple[int, int] | None = None
    node_place: Floats | None = None

    @property
    def length(self) -> float:
        """Along the midrib; NaN without a shape."""
        return math.nan if self.midrib is None else float(np.linalg.norm(np.diff(self.midrib, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class PlantOnDate:
    """One plant on one date.

    Attributes:
        time: days; of ISO dates, days after the first of all dates.
        written: the time as the user gave it.
        unit: of its lengths, "" when unknown.
        knows_up: +z of its frame is up.
        leaves: those that count as leaves, or may do so, by id.
        up_from: where up comes from, see `Traits.up_from`.
        folder: of the result; None in memory.
        pictures: {leaf: picture} for a page; empty where nobody asked for them.
        photo: JPEG of the plant for a page, or nothing.
    """

    scene: str
    time: float
    written: str
    unit: str
    knows_up: bool
    leaves: tuple[SeenLeaf, ...]
    whole: Numbers
    up_from: str = ""
    folder: Path | None = None
    pictures: Mapping[int, LeafPicture] = field(default_factory=dict)
    photo: bytes = b""

    @property
    def shaped(self) -> list[int]:
        return [index for index, leaf in enumerate(self.leaves) if leaf.midrib is not None]


def read_date(folder: Path, time: str | float, *, pictures: int = 0) -> PlantOnDate:
    """One date from a result folder of `mvseg infer` or `mvseg batch`; `time` as in `read_time`. Pictures of its leaves
    are so many pixels wide or high; 0: without.

    Raises InputError: there is no result, it has no surfaces (`mvseg match` measures none), or its files are broken.
    """
    folder = find_result(folder)
    with collect_warnings():  # of cameras, which nobody needs here
        result = load_result(folder)
    if result.traits is None:
        raise InputError(f"{folder}: has ids but no surfaces, run mvseg infer or mvseg batch with these masks first")
    date = replace(date_of(result, time), scene=folder.name, folder=folder)
    if not pictures:
        return date
    of_leaves, of_plant = draw_pictures(result, [leaf.leaf for leaf in date.leaves], side=pictures)
    return replace(date, pictures=of_leaves, photo=of_plant)


def date_of(result: Result, time: str | float) -> PlantOnDate:
    """One date from a result in memory. Raises InputError: it has no surfaces."""
    traits = result.traits
    if traits is None:
        raise InputError(f"{result.scene.name}: has ids but no surfaces, expected a run with reconstruct and traits")
    frame, leaves = level_frame(traits.up) if traits.up is not None and traits.up_from == "scene" else None, []

    def numbers_of(measured: Mapping[str, Measurement]) -> dict[str, Number]:
        units = {name: unit_of(KINDS[name], traits.unit) for name in measured}
        return {name: Number(m.value, m.sd, units[name]) for name, m in measured.items() if m.exists}

    nodes = {node.leaf: (stem.number, node) for stem in traits.stems for node in stem.nodes}
    for leaf in traits.leaves:
        if leaf.rejection is None or leaf.rejection == "stem":
            shape = best_shape(leaf.leaf, result.surfaces, result.voxels)
            stem, node = nodes.get(leaf.leaf, (0, None))
            of_node = {} if node is None else {name: getattr(node, name) for name in OF_NODES}
            observation = _see_leaf(leaf.leaf, shape, numbers_of({**leaf.numbers, **of_node}), frame)
            if node is not None:
                place = np.array(node.place) if frame is None else frame @ np.array(node.place)
                observation = replace(observation, node=(stem, node.number), node_place=place)
            leaves.append(replace(observation, is_doubted=leaf.rejection is not None))
    return PlantOnDate(
        scene=result.scene.name, time=read_time(time), written=str(time).strip(), unit=traits.unit,
        knows_up=frame is not None, leaves=tuple(leaves), whole=numbers_of(traits.whole), up_from=traits.up_from,
    )  # fmt: skip


def read_time(time: str | float) -> float:
    """Days: the number itself, or days since year 1 of an ISO date (20260531, too; with a time of day and a time zone,
    if you like: then it is counted in UTC).

    Raises InputError: it is neither; so are 0428 and numbers of `OBSERVATIONS.most_days` or more, which are no days.
    """
    moment = _read_moment(str(time).strip())
    if isinstance(moment, float):
        return moment
    if moment.tzinfo is not None:
        moment = moment.astimezone(datetime.UTC).replace(tzinfo=None)
    return 1 + (moment - datetime.datetime.min) / datetime.timedelta(days=1)


def _read_moment(text: str) -> float | datetime.datetime:
    if NUMBER.fullmatch(text) and abs(float(text)) < OBSERVATIONS.most_days:
        return float(text)
    with suppress(ValueError):
        if not text.isdecimal() or len(text) == 8:  # 13 digits would be a date of the year 1711
            return datetime.datetime.fromisoformat(text)
    expected = f"expected a number (days) or an ISO date, as in 2026-05-31; days are below {OBSERVATIONS.most_days}"
    raise InputError(f"time '{text}': {expected}")


def order_dates(dates: Sequence[PlantOnDate]) -> tuple[PlantOnDate, ...]:
    """The dates in order of time, all lengths in the unit of the first. Raises InputError: two dates have the same
    time, numbers and ISO dates are mixed, units cannot be converted, or a leaf has points that are no numbers."""
    for date in dates:
        for leaf in date.leaves:
            if not all(each is None or np.isfinite(each).all() for each in (leaf.midrib, leaf.normal, leaf.points)):
                raise InputError(f"{date.scene}: leaf {leaf.leaf} has points that are no finite numbers")
    moments = [_read_moment(date.written) for date in dates]
    are_iso = {isinstance(moment, datetime.datetime) for moment in moments}
    if len(are_iso) > 1:
        raise InputError("the times are numbers and ISO dates, expected one of the two for all dates of a plant")
    if len({getattr(moment, "tzinfo", None) is None for moment in moments}) > 1:
        raise InputError("some times have a time zone and others have none, expected one for all dates of a plant")
    ordered = sorted(dates, key=lambda date: date.time)
    for earlier, later in pairwise(ordered):
        if earlier.time == later.time:
            message = f"{earlier.scene} and {later.scene} have the same time {later.written}"
            raise InputError(f"{message}, expected each date of a plant once")
    start = math.floor(ordered[0].time) if are_iso == {True} else 0.0
    return tuple(replace(_in_unit(date, ordered[0]), time=date.time - start) for date in ordered)


def name_apart(dates: Sequence[PlantOnDate]) -> list[PlantOnDate]:
    """The dates, those whose results have one name with as much of their folders as tells them apart: of mon/plant and
    fri/plant just this. Results in memory keep their names."""
    named, before, parts = list(dates), list[str](), 1
    while (scenes := [date.scene for date in named]) != before:  # none changes once all differ, or no folder is longer
        before, parts = scenes, parts + 1
        named = [replace(date, scene="/".join(date.folder.resolve().parts[-parts:]))
                 if date.folder is not None and scenes.count(date.scene) > 1 else date for date in named]  # fmt: skip
    return named


def _in_unit(date: PlantOnDate, first: PlantOnDate) -> PlantOnDate:
    if date.unit == first.unit:
        return date
    if date.unit not in UNITS or first.unit not in UNITS:
        message = f"{first.scene} is in {first.unit or 'no unit'} and {date.scene} in {date.unit or 'no unit'}"
        raise InputError(f"{message}, expected one unit for all dates, or m, cm and mm (--unit, --scale)")
    factor = UNITS[date.unit] / UNITS[first.unit]
    units = {f"{date.unit}{power}": (f"{first.unit}{power}", factor**n) for n, power in enumerate(("", "^2", "^3"), 1)}

    def convert(numbers: Numbers) -> Numbers:
        found = {name: (number, *units.get(number.unit, (number.unit, 1.0))) for name, number in numbers.items()}
        return {name: Number(n.value * times, n.sd * times, unit) for name, (n, unit, times) in found.items()}

    def enlarge(leaf: SeenLeaf) -> SeenLeaf:
        places = {name: getattr(leaf, name) for name in ("midrib", "points", "node_place")}
        enlarged = {name: each * factor for name, each in places.items() if each is not None}
        return replace(leaf, numbers=convert(leaf.numbers), **enlarged)

    return replace(date, unit=first.unit, leaves=tuple(map(enlarge, date.leaves)), whole=convert(date.whole))


def _see_leaf(number: int, shape: LeafSurface | VoxelGrid | None, numbers: Numbers, frame: Floats | None) -> SeenLeaf:
    mesh = shape.mesh(*MESH_SHAPE) if isinstance(shape, LeafSurface) else None if shape is None else shape.mesh()
    vertices = np.zeros((0, 3)) if mesh is None else np.asarray(mesh.vertices)
    if len(vertices) < OBSERVATIONS.cloud:
        return SeenLeaf(number, None, None, None, False, numbers)
    points = vertices if frame is None else vertices @ frame.T
    if isinstance(shape, LeafSurface):
        return see_surface(number, points, MESH_SHAPE[1], numbers, is_oriented=shape.is_oriented)
    midrib, normal = _midrib_of_voxels(points)
    cloud = points[np.linspace(0, len(points) - 1, OBSERVATIONS.cloud).round().astype(int)]
    return SeenLeaf(number, midrib, normal, cloud, False, numbers)


def see_surface(number: int, vertices: Floats, columns: int, numbers: Numbers, *, is_oriented: bool) -> SeenLeaf:
    """A leaf from the vertices (P, 3) of its surface: the base, rows of a grid with so many columns, and the tip."""
    grid = vertices[1:-1].reshape(-1, columns, 3)
    midrib = resample(np.concatenate([vertices[:1], grid[:, columns // 2], vertices[-1:]]))
    normal = cell_normals(grid).sum((0, 1))
    rows = np.linspace(0, len(grid) - 1, OBSERVATIONS.rows).round().astype(int)
    cloud = grid[rows][:, [0, columns // 2, -1]].reshape(-1, 3)
    return SeenLeaf(number, midrib, normal / max(float(np.linalg.norm(normal)), 1e-12), cloud, is_oriented, numbers)


def resample(line: Floats) -> Floats:
    """(`OBSERVATIONS.stations`, 3) points evenly spread along a line (P, 3)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], OBSERVATIONS.stations)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in range(3)], 1)


def _midrib_of_voxels(points: Floats) -> tuple[Floats, Floats]:
    """A line through the middle of a long cloud, and the direction in which it is thinnest."""
    center = points.mean(0)
    _, _, axes = np.linalg.svd(points - center, full_matrices=False)
    along = (points - center) @ axes[0]
    edges = np.linspace(along.min(), along.max(), OBSERVATIONS.stations + 1)
    bins = np.clip(np.digitize(along, edges) - 1, 0, OBSERVATIONS.stations - 1)
    line = np.stack([points[bins == index].mean(0) for index in range(OBSERVATIONS.stations) if (bins == index).any()])
    ends = points[[along.argmin(), along.argmax()]]
    return resample(np.concatenate([ends[:1], line[1:-1], ends[1:]])), axes[2]
