"""Leaves of one plant over all of its dates, start to finish."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mvseg.errors import InputError
from mvseg.tracking.associate import DatePair, Link, Sight, compare_dates, link_leaves
from mvseg.tracking.costs import leaves_of
from mvseg.tracking.dates import Floats, PlantOnDate, date_of, order_dates, read_date

if TYPE_CHECKING:
    from mvseg.results.result import Result

State = Literal["born", "seen", "hidden", "gone"]


@dataclass(frozen=True)
class LeafLink:
    """What a person says of leaves: `leaves` are (scene, leaf) pairs, all of one leaf, or of different ones."""

    is_same: bool
    leaves: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class TrackRow:
    """One leaf on one date, or a date on which a track has none.

    Attributes:
        date: index into `Tracks.dates`.
        leaf: its id in that date's result; None where the track is hidden or gone.
        track: from 1 on, in the order of appearance.
        probability: that the leaf is the one that the track showed before; of the first one of a track, that it is none
            of the tracks before. NaN where there is no leaf, or nothing to compare with.
        state: "born" where it appears after the first date, "seen", "hidden" where it is missing between two sights,
            "gone" on the first date on which it is missing for good.
    """

    date: int
    leaf: int | None
    track: int
    probability: float
    state: State


@dataclass(frozen=True, eq=False)
class Tracks:
    """The leaves of one plant over days.

    Attributes:
        plant: its name.
        dates: in the order of time, all in the unit of the first.
        rows: by date, then by track.
        poses: (T, 4, 4) first_from_date, where the frame of a date stands in that of the first date it is surely
            aligned with, by way of others; NaN where it is aligned with none before it.
        warnings: dates that could not be aligned, and why.
    """

    plant: str
    dates: tuple[PlantOnDate, ...]
    rows: tuple[TrackRow, ...]
    poses: Floats
    warnings: tuple[str, ...]

    @property
    def num_tracks(self) -> int:
        return max((row.track for row in self.rows), default=0)


def track_leaves(
    results: Sequence[Path | str | Result | PlantOnDate],
    times: Sequence[float | str] | None = None,
    *,
    links: Sequence[LeafLink] = (),
    plant: str = "plant",
) -> Tracks:
    """The same leaf, with the same track, on all dates of a plant.

    Frames of different dates need not agree: the pot may have been turned, shifted and set down askew, and the cameras
    may be others. Lengths must be to one scale; units that differ are converted.

    Args:
        results: of two dates or more, in any order: result folders of `mvseg infer` or `mvseg batch`, `Result`s in
            memory, or `PlantOnDate`s.
        times: of each result: numbers (days) or ISO dates; None: 0, 1, 2, ...
        links: what a person says.
        plant: its name.

    Returns:
        The tracks. Dates that cannot be aligned surely with those before them start tracks of their own, and
        `Tracks.warnings` says why: no link is a guess. Leaves without a shape get a track of that date alone.

    Raises:
        InputError: fewer than two results, another number of times, times that repeat, units that cannot be converted,
            a result without surfaces, or a link that contradicts itself or names no leaf.
    """
    if times is not None and len(times) != len(results):
        raise InputError(f"{len(results)} results have {len(times)} times, expected one for each")
    if len(results) < 2:
        raise InputError(f"{plant}: has {len(results)} date, expected two or more")
    written = list(range(len(results))) if times is None else times
    dates = order_dates([_date(result, time) for result, time in zip(results, written, strict=True)])
    leaves = [leaves_of(date) for date in dates]
    knows_up = all(date.knows_up for date in dates)
    compared = compare_dates(leaves, [date.time for date in dates], knows_up=knows_up)
    same, different = _sights_of(links, dates)
    links_found = link_leaves([len(each) for each in leaves], compared, same=same, different=different)
    index = [each.index for each in leaves]
    rows = _rows(dates, _chains(dates, links_found, index), compared)
    return Tracks(plant, dates, rows, _poses(len(dates), compared), _warnings(dates, compared))


def _date(result: Path | str | Result | PlantOnDate, time: float | str) -> PlantOnDate:
    if isinstance(result, PlantOnDate):
        return result
    return read_date(Path(result), time) if isinstance(result, Path | str) else date_of(result, time)


def _sights_of(
    links: Sequence[LeafLink], dates: Sequence[PlantOnDate]
) -> tuple[list[tuple[Sight, Sight]], list[tuple[Sight, Sight]]]:
    """Pairs of rows of `Leaves` that are one leaf, in the order of time, and pairs that are not."""
    scenes = {date.scene: index for index, date in enumerate(dates)}
    if links and len(scenes) < len(dates):
        raise InputError("two dates have results of one name, expected different names where links name them")
    same, different = [], []
    for link in links:
        sights = []
        for scene, leaf in link.leaves:
            if scene not in scenes:
                raise InputError(f"a link names the scene {scene}, expected one of {', '.join(scenes)}")
            date = dates[scenes[scene]]
            rows = [row for row, place in enumerate(date.shaped) if date.leaves[place].leaf == leaf]
            if not rows:
                raise InputError(f"a link names leaf {leaf} of {scene}, which is no leaf with a shape")
            sights.append((scenes[scene], rows[0]))
        sights.sort()
        if link.is_same and len({date for date, _ in sights}) < len(sights):
            raise InputError(f"a link says that two leaves of {dates[sights[0][0]].scene} are one, over days none are")
        if link.is_same:
            same += list(pairwise(sights))
        else:
            different += [(one, other) for one, other in combinations(sights, 2) if one[0] != other[0]]
    if set(same) & set(different):
        raise InputError("two leaves are said to be the same and to be different")
    return same, different


def _chains(
    dates: Sequence[PlantOnDate], links: Sequence[Link], index: Sequence[np.ndarray]
) -> list[list[tuple[int, int, float]]]:
    """Tracks as lists of (date, place in its leaves, probability), in the order of appearance; leaves without a shape
    are tracks of one date."""
    after = {(link.before[0], int(index[link.before[0]][link.before[1]])): link for link in links}
    later = {(link.after[0], int(index[link.after[0]][link.after[1]])) for link in links}
    chains = []
    for date, seen in enumerate(dates):
        for place in range(len(seen.leaves)):
            if (date, place) in later:
                continue
            chain, at = [(date, place, math.nan)], (date, place)
            while at in after:
                link = after[at]
                at = link.after[0], int(index[link.after[0]][link.after[1]])
                chain.append((*at, link.probability))
            chains.append(chain)
    return chains


def _rows(
    dates: Sequence[PlantOnDate],
    chains: Sequence[Sequence[tuple[int, int, float]]],
    compared: dict[tuple[int, int], DatePair],
) -> tuple[TrackRow, ...]:
    rows = []
    for track, chain in enumerate(chains, start=1):
        first, last = chain[0][0], chain[-1][0]
        seen = {date: (place, probability) for date, place, probability in chain}
        for date in range(first, last + 1):
            if date not in seen:
                rows.append(TrackRow(date, None, track, math.nan, "hidden"))
                continue
            place, probability = seen[date]
            state: State = "seen"
            if date == first and _is_sure(compared, date - 1, date):
                state = "born"
            rows.append(TrackRow(date, dates[date].leaves[place].leaf, track, probability, state))
        if _is_sure(compared, last, last + 1):
            rows.append(TrackRow(last + 1, None, track, math.nan, "gone"))
    return tuple(sorted(rows, key=lambda row: (row.date, row.track)))


def _is_sure(compared: dict[tuple[int, int], DatePair], earlier: int, later: int) -> bool:
    return (earlier, later) in compared and compared[earlier, later].alignment.is_sure


def _poses(num_dates: int, compared: dict[tuple[int, int], DatePair]) -> Floats:
    """(T, 4, 4) first_from_date by way of the nearest earlier date that is surely aligned."""
    poses = np.full((num_dates, 4, 4), np.nan)
    for later in range(num_dates):
        poses[later] = np.nan
        for earlier in range(later - 1, -1, -1):
            if _is_sure(compared, earlier, later):
                start = np.eye(4) if np.isnan(poses[earlier]).any() else poses[earlier]
                alignment, step = compared[earlier, later].alignment, np.eye(4)
                step[:3, :3] = alignment.rotation.T
                step[:3, 3] = -alignment.rotation.T @ alignment.shift
                poses[later] = start @ step
                break
    return poses


def _warnings(dates: Sequence[PlantOnDate], compared: dict[tuple[int, int], DatePair]) -> tuple[str, ...]:
    said = []
    for later in range(1, len(dates)):
        if any(_is_sure(compared, earlier, later) for earlier in range(later)):
            continue
        reason = compared[later - 1, later].alignment.reason
        pair = f"{dates[later - 1].scene} and {dates[later].scene}"
        said.append(f"{pair} cannot be aligned surely ({reason}): their leaves are not linked")
    if not all(date.knows_up for date in dates):
        said.append("up is not known on all dates (--up): any turn of the plant was looked at, which is less sure")
    shapeless = sum(len(date.leaves) - len(date.shaped) for date in dates)
    if shapeless:
        said.append(f"{shapeless} leaves have no shape (seen in one view): each is a track of one date")
    return tuple(said)
