"""Leaves of one plant over all of its dates, start to finish."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mvseg.arrays import Floats
from mvseg.corrections.track_links import LeafLink
from mvseg.errors import InputError
from mvseg.findings.finding import Finding
from mvseg.tracking.associate import Association, link_leaves, pairwise_chances, sum_over_poses
from mvseg.tracking.compare import Asked, Comparison, Observation, compare_dates
from mvseg.tracking.config import Pots
from mvseg.tracking.dates import PlantOnDate, date_of, name_apart, order_dates, read_date
from mvseg.tracking.leaves import leaves_of
from mvseg.tracking.numbers import ALIGN

if TYPE_CHECKING:
    from mvseg.results.result import Result

State = Literal["born", "seen", "hidden", "gone"]


@dataclass(frozen=True)
class TrackRow:
    """One leaf on one date, or a date on which a track has none.

    Attributes:
        date: index into `Tracks.dates`.
        track: from 1 on: from below, by the mean height of its base, where up is known on all dates; otherwise in the
            order of appearance. The plants of other frames (`Tracks.roots`) and leaves without a shape come last.
        state: "born" where it appears after the first date, "seen", "hidden" between two observations, "gone" on the
            first date on which it is missing for good.
        leaf: its id in that date's result; None where the track is hidden or gone.
        probability: that the leaf is the one that the track showed before; NaN of the first one of a track, and where
            there is no leaf.
    """

    date: int
    track: int
    state: State
    leaf: int | None = None
    probability: float = math.nan


@dataclass(frozen=True, eq=False)
class Tracks:
    """The leaves of one plant over days.

    Attributes:
        dates: in the order of time, all in the unit of the first.
        rows: by date, then by track.
        poses: (T, 4, 4) first_from_date, from the frame of a date to that of the earliest date that it is aligned with,
            directly or by way of other dates.
        roots: (T,) index of that earliest date.
        findings: dates whose alignment is a guess, leaves that moved by themselves, leaves without a shape.
        chances: see `pairwise_chances`; rows and columns are those of `PlantOnDate.shaped`.
    """

    plant: str
    dates: tuple[PlantOnDate, ...]
    rows: tuple[TrackRow, ...]
    poses: Floats
    roots: tuple[int, ...]
    findings: tuple[Finding, ...]
    chances: Mapping[tuple[int, int], Floats] = field(default_factory=dict)

    @property
    def num_tracks(self) -> int:
        return max((row.track for row in self.rows), default=0)


def list_observations(tracks: Tracks) -> dict[int, list[tuple[tuple[int, int], float]]]:
    """{track: (date, leaf) in the order of time, each with the probability of its link to the one before}."""
    observations: dict[int, list[tuple[tuple[int, int], float]]] = {}
    for row in tracks.rows:
        if row.leaf is not None:
            observations.setdefault(row.track, []).append(((row.date, row.leaf), row.probability))
    return observations


def track_leaves(
    results: Sequence[Path | str | Result | PlantOnDate],
    times: Sequence[float | str] | None = None,
    *,
    links: Sequence[LeafLink] = (),
    pots: Pots = "auto",
    plant: str = "plant",
) -> Tracks:
    """The same leaf, with the same track, on all dates of a plant.

    Frames of different dates need not agree: the pot may have been turned, shifted and set down askew, and the cameras
    may be others. Lengths must be to one scale; units that differ are converted.

    Args:
        results: of two dates or more, in any order: result folders of `mvseg infer` or `mvseg batch`, `Result`s in
            memory, or `PlantOnDate`s.
        times: of each result: numbers (days) or ISO dates; None: 0, 1, 2, ...
        pots: "fixed": they stand as they stood, and frames agree; "turned": any turn is as likely as none; "auto":
            standing is likelier than any single turn (`ALIGN.still`).

    Returns:
        The tracks. Of each two dates the likeliest alignment is taken, the probability of a link follows from its, and
        `Tracks.findings` names those that are guesses. Leaves without a shape get a track of that date alone.

    Raises:
        InputError: fewer than two results, another number of times, times that repeat, units that cannot be converted,
            a result without surfaces, or a link that contradicts itself or names no leaf.
    """
    if times is not None and len(times) != len(results):
        raise InputError(f"{len(results)} results have {len(times)} times, expected one for each")
    if len(results) < 2:
        raise InputError(f"{plant}: has {len(results)} date, expected two or more")
    written = range(len(results)) if times is None else times
    dates = order_dates(name_apart([
        result if isinstance(result, PlantOnDate)
        else read_date(Path(result), time) if isinstance(result, Path | str)
        else date_of(result, time)
        for result, time in zip(results, written, strict=True)
    ]))  # fmt: skip
    compared, associations = _link_dates(dates, links, pots)
    believed = _without_stems(dates, associations, {leaf for link in links for leaf in link.leaves})
    if believed != dates:
        dates = believed
        compared, associations = _link_dates(dates, links, pots)
    rows = _rank_tracks(_rows(dates, associations, compared.roots), dates, compared)
    roots, findings = tuple(compared.roots.tolist()), tuple(_find_doubts(dates, compared))
    return Tracks(plant, dates, rows, compared.poses, roots, findings, chances=pairwise_chances(compared))


def _link_dates(
    dates: Sequence[PlantOnDate], statements: Sequence[LeafLink], pots: Pots
) -> tuple[Comparison, list[Association]]:
    leaves = [leaves_of(date) for date in dates]
    knows_up = all(date.knows_up for date in dates)
    same, different = _observations_of(statements, dates)
    times, counts = [date.time for date in dates], [len(each) for each in leaves]
    compared = compare_dates(leaves, times, knows_up=knows_up, pots=pots, same=same, different=different)
    doubted = np.concatenate([each.is_doubted for each in leaves])
    links = link_leaves(counts, compared.costs, same=same, different=different, doubted=doubted)
    return compared, sum_over_poses(links, compared)


def _without_stems(
    dates: tuple[PlantOnDate, ...], links: Sequence[Association], named: Collection[tuple[str, int]]
) -> tuple[PlantOnDate, ...]:
    """The dates without what looks like a stem wherever it is seen; those (scene, leaf) that the user names stay."""
    observations = [(n, row) for n, date in enumerate(dates) for row in range(len(date.shaped))]
    track = {observation: observation for observation in observations}
    for link in links:  # by their earlier observation
        track[link.after] = track[link.before]
    sure = {track[n, row] for n, row in observations if not dates[n].leaves[dates[n].shaped[row]].is_doubted}
    believed = []
    for n, date in enumerate(dates):
        in_tracks = {date.leaves[place].leaf for row, place in enumerate(date.shaped) if track[n, row] in sure}
        in_tracks |= {leaf for scene, leaf in named if scene == date.scene}
        left = tuple(leaf for leaf in date.leaves if not leaf.is_doubted or leaf.leaf in in_tracks)
        believed.append(date if len(left) == len(date.leaves) else replace(date, leaves=left))
    return tuple(believed)


def _observations_of(links: Sequence[LeafLink], dates: Sequence[PlantOnDate]) -> tuple[Asked, Asked]:
    rows = {date.scene: (index, {date.leaves[n].leaf: k for k, n in enumerate(date.shaped)})
            for index, date in enumerate(dates)}  # fmt: skip
    if links and len(rows) < len(dates):
        raise InputError("two dates have results of one name, expected different names where links name them")
    same, different = list[tuple[Observation, Observation]](), list[tuple[Observation, Observation]]()
    for link in links:
        observations = []
        for scene, leaf in link.leaves:
            if scene not in rows:
                raise InputError(f"a link names the scene {scene}, expected one of {', '.join(rows)}")
            index, row_of = rows[scene]
            if leaf not in row_of:
                raise InputError(f"a link names leaf {leaf} of {scene}, which is no leaf with a shape")
            observations.append((index, row_of[leaf]))
        observations.sort()
        if link.is_same and len({date for date, _ in observations}) < len(observations):
            scene = dates[observations[0][0]].scene
            raise InputError(f"a link says that two leaves of {scene} are one, expected leaves of different dates")
        if link.is_same:
            same += list(pairwise(observations))
        else:
            different += [(one, other) for one, other in combinations(observations, 2) if one[0] != other[0]]
    if set(same) & set(different):
        raise InputError("two leaves are said to be the same and to be different")
    return same, different


def _rows(dates: Sequence[PlantOnDate], links: Sequence[Association], roots: np.ndarray) -> tuple[TrackRow, ...]:
    place_of = {(n, row): (n, place) for n, date in enumerate(dates) for row, place in enumerate(date.shaped)}
    after = {place_of[link.before]: (place_of[link.after], link.probability) for link in links}
    later = {at for at, _ in after.values()}
    starts = [(n, k) for n, date in enumerate(dates) for k in range(len(date.leaves)) if (n, k) not in later]
    rows = []
    for track, start in enumerate(starts, start=1):
        state: State = "born" if start[0] > 0 and roots[start[0] - 1] == roots[start[0]] else "seen"
        (date, place), chance = start, math.nan
        while True:
            leaf = dates[date].leaves[place].leaf
            rows.append(TrackRow(date=date, track=track, state=state, leaf=leaf, probability=chance))
            if (date, place) not in after:
                break
            before, ((date, place), chance), state = date, after[date, place], "seen"
            rows += [TrackRow(date=n, track=track, state="hidden") for n in range(before + 1, date)]
        if date + 1 < len(dates) and roots[date] == roots[date + 1]:
            rows.append(TrackRow(date=date + 1, track=track, state="gone"))
    return tuple(sorted(rows, key=lambda row: (row.date, row.track)))


def _rank_tracks(rows: Sequence[TrackRow], dates: Sequence[PlantOnDate], compared: Comparison) -> tuple[TrackRow, ...]:
    bases = {(n, leaf.leaf): leaf.midrib for n, date in enumerate(dates) for leaf in date.leaves if date.knows_up}
    heights: dict[int, list[float]] = {row.track: [] for row in rows}
    first = dict[int, int]()  # root of each track
    for row in rows:
        midrib = None if row.leaf is None else bases.get((row.date, row.leaf))
        first.setdefault(row.track, int(compared.roots[row.date]))
        if midrib is not None:
            pose = compared.poses[row.date]
            heights[row.track].append(float(pose[2, :3] @ midrib[0] + pose[2, 3]))
    if not all(date.knows_up for date in dates):
        return tuple(rows)
    scale = max(max(map(abs, each), default=0.0) for each in heights.values()) if heights else 0.0
    digits = 6 - math.ceil(math.log10(scale)) if scale else 6  # no order hangs on the last bit
    place = {
        track: (first[track], not each, round(sum(each) / len(each), digits) if each else 0.0, track)
        for track, each in heights.items()
    }
    number = {track: n for n, track in enumerate(sorted(place, key=lambda track: place[track]), start=1)}
    ranked = [replace(row, track=number[row.track]) for row in rows]
    return tuple(sorted(ranked, key=lambda row: (row.date, row.track)))


def _find_doubts(dates: Sequence[PlantOnDate], compared: Comparison) -> Iterator[Finding]:
    for later in range(1, len(dates)):
        chance = compared.trust[later - 1, later]
        if chance < ALIGN.told:
            pair = f"{dates[later - 1].scene} and {dates[later].scene}"
            yield Finding("pot_guessed", pair, {"likely": f"{chance:.0%}" if chance >= 0.01 else "less than 1%"})
    if not all(date.knows_up for date in dates):
        yield Finding("dates_without_up")
    if shapeless := sum(len(date.leaves) - len(date.shaped) for date in dates):
        yield Finding("leaves_without_shape", values={"count": shapeless})
