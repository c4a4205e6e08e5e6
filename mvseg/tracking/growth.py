"""Growth: rates of each leaf, and what the plant as a whole does from date to date.

Standard deviations are those of the surfaces, carried through; errors of different dates count as independent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mvseg.arrays import Floats
from mvseg.tracking.dates import Number
from mvseg.tracking.track import Tracks, list_observations

TRAITS = (
    "area", "length", "width", "inclination", "curvature", "insertion_height", "node_height", "internode",
    "greenness_index",
)  # fmt: skip
HEIGHTS = ("insertion_height", "node_height")  # start somewhere on each date
NOTHING = Number(math.nan, math.nan, "")


@dataclass(frozen=True)
class GrowthPoint:
    """One trait of one leaf on one date; `rate` per day is the slope through this date and its neighbours (of two dates
    the later one has it)."""

    track: int
    trait: str
    date: int
    number: Number
    rate: float
    rate_sd: float


@dataclass(frozen=True)
class PlantRow:
    """The plant on one date; NaN where there is no number.

    Attributes:
        date: index into `Tracks.dates`.
        leaves, born, gone: numbers of leaves, and of leaves that appeared or went since the date before.
        phyllochron: days per leaf that appeared, since the first date.
        total_area: with its standard deviation.
        relative_growth_rate: of the area of those leaves that are measured on this date and the one before, per day,
            with its standard deviation.
    """

    date: int
    leaves: int
    born: int
    gone: int
    phyllochron: float
    total_area: Number
    relative_growth_rate: Number


@dataclass(frozen=True)
class Growth:
    """Growth of all leaves, by track, trait and time, where measured; and of the plant, one row per date."""

    points: tuple[GrowthPoint, ...]
    plant: tuple[PlantRow, ...]


def measure_growth(tracks: Tracks) -> Growth:
    """The growth of all leaves, and of the plant.

    Heights of a pot whose lowest leaf is another one from some date on start from the base of the lowest leaf that all
    dates have; where there is none, no rate is between dates of different origins. The same holds for heights along
    different stems, and for internodes above different leaves.
    """
    numbers = [{leaf.leaf: leaf.numbers for leaf in date.leaves} for date in tracks.dates]
    observations_of = sorted(list_observations(tracks).items())
    points: list[GrowthPoint] = []
    for trait in TRAITS:
        by_track = {
            track: {date: numbers[date][leaf][trait] for (date, leaf), _ in own if trait in numbers[date][leaf]}
            for track, own in observations_of
        }
        origins = find_origins(tracks, trait)
        if trait in HEIGHTS:
            by_track, origins = _with_one_origin(tracks, by_track, origins)
        for track, by_date in by_track.items():
            points += _points(tracks, track, trait, by_date, origins={date: origins[date, track] for date in by_date})
    points.sort(key=lambda point: (point.track, TRAITS.index(point.trait)))
    return Growth(tuple(points), tuple(_plant_rows(tracks, points)))


def _points(
    tracks: Tracks, track: int, trait: str, by_date: Mapping[int, Number], *, origins: Mapping[int, Hashable]
) -> Iterator[GrowthPoint]:
    dates, is_told = list(by_date), len(by_date) > 2
    times = np.array([tracks.dates[date].time for date in dates])
    values, sds = (np.array([getattr(number, name) for number in by_date.values()]) for name in ("value", "sd"))
    for place, (date, number) in enumerate(by_date.items()):
        around = range(max(place - 1, 0), min(place + 2, len(dates)))
        near = [each for each in around if origins[dates[each]] == origins[date]]
        rates = slope(times[near], values[near], sds[near]) if place > 0 or is_told else (math.nan, math.nan)
        yield GrowthPoint(track, trait, date, number, *rates)


def find_origins(tracks: Tracks, trait: str) -> dict[tuple[int, int], Hashable]:
    """{(date, track): where numbers of a trait start}: those of equal origins may be compared."""
    track_of = {(row.date, row.leaf): row.track for row in tracks.rows if row.leaf is not None}
    origins: dict[tuple[int, int], Hashable] = {}
    for index, date in enumerate(tracks.dates):
        axis = index if date.up_from == "stem" else -1  # a stem leans otherwise on each date
        blades = [leaf for leaf in date.leaves if leaf.points is not None and "insertion_height" in leaf.numbers]
        lowest = min(blades, key=lambda leaf: float(np.asarray(leaf.points)[:, 2].min()), default=None)
        nodes: dict[tuple[int, int], set[int]] = {}
        for leaf in date.leaves:
            if leaf.node is not None:
                nodes.setdefault(leaf.node, set()).add(track_of[index, leaf.leaf])
        for leaf in date.leaves:
            key: Hashable = ()
            if trait == "insertion_height":
                key = axis, None if lowest is None else track_of[index, lowest.leaf]
            elif trait == "inclination":
                key = axis
            elif leaf.node is not None and trait in ("node_height", "internode"):
                stem, node = leaf.node
                key = frozenset(nodes.get((stem, 1 if trait == "node_height" else node - 1), ())) or None
            origins[index, track_of[index, leaf.leaf]] = key
    return origins


def _with_one_origin(
    tracks: Tracks, by_track: Mapping[int, Mapping[int, Number]], origins: Mapping[tuple[int, int], Hashable]
) -> tuple[dict[int, dict[int, Number]], dict[tuple[int, int], Hashable]]:
    """Heights {track: {date: number}} and origins; several origins become one leaf that all dates have."""
    moved, same = {track: dict(numbers) for track, numbers in by_track.items()}, dict(origins)
    for root in set(tracks.roots):
        dates = [date for date, each in enumerate(tracks.roots) if each == root]
        keys = {origins[date, track] for track, numbers in by_track.items() for date in numbers if date in dates}
        whole = [track for track, numbers in by_track.items() if numbers.keys() >= set(dates)]
        if len(keys) < 2 or not whole or any(tracks.dates[date].up_from == "stem" for date in dates):
            continue
        reference = min(whole, key=lambda track: np.mean([by_track[track][date].value for date in dates]))
        for track, numbers in by_track.items():
            for date in numbers.keys() & set(dates):
                number, start = numbers[date], by_track[reference][date]
                sd = 0.0 if track == reference else math.hypot(number.sd, start.sd)
                moved[track][date] = Number(number.value - start.value, sd, number.unit)
                same[date, track] = ("one origin", root)
    return moved, same


def slope(times: Floats, values: Floats, sds: Floats) -> tuple[float, float]:
    """The slope of the straight line through two or three values, weighted by their certainty, and its standard
    deviation; NaN for fewer, and where the values have none."""
    if len(times) < 2:
        return math.nan, math.nan
    is_known = bool((np.isfinite(sds) & (sds > 0)).all())
    line, covariance = np.polyfit(times - times.mean(), values, 1, w=1 / sds if is_known else None, cov="unscaled")
    return float(line[0]), math.sqrt(covariance[0, 0]) if is_known else math.nan


def _plant_rows(tracks: Tracks, points: Sequence[GrowthPoint]) -> Iterator[PlantRow]:
    areas: dict[int, dict[int, Number]] = {}
    for point in points:
        if point.trait == "area":
            areas.setdefault(point.date, {})[point.track] = point.number
    states, total_born = Counter((row.date, row.state) for row in tracks.rows), 0
    for index, date in enumerate(tracks.dates):
        born, gone = states[index, "born"], states[index, "gone"]
        total_born += born
        phyllochron = (date.time - tracks.dates[0].time) / total_born if total_born else math.nan
        days = date.time - tracks.dates[max(index - 1, 0)].time
        growth = _relative_growth(areas.get(index - 1, {}), areas.get(index, {}), days)
        area = date.whole.get("total_leaf_area", NOTHING)
        yield PlantRow(index, len(date.leaves), born, gone, phyllochron, area, relative_growth_rate=growth)


def _relative_growth(before: Mapping[int, Number], now: Mapping[int, Number], days: float) -> Number:
    both = before.keys() & now.keys()
    if not both:
        return NOTHING
    sums = [sum(numbers[track].value for track in both) for numbers in (before, now)]
    errors = [math.hypot(*(numbers[track].sd for track in both)) for numbers in (before, now)]
    sd = math.hypot(errors[0] / sums[0], errors[1] / sums[1])
    return Number(math.log(sums[1] / sums[0]) / days, sd / days, "1/day")
