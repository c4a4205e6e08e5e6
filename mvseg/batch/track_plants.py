"""Plants over days, one after another or side by side, from the output of a batch or from single results."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mvseg._version import made_by
from mvseg.batch.status import TABLES
from mvseg.batch.workers import Lost, run_locally
from mvseg.corrections.file import Edit, load_corrections
from mvseg.errors import InputError
from mvseg.results.earlier import RUN_FILE, Output, replace_result
from mvseg.system.file_hash import hash_files
from mvseg.system.running import progress_bar
from mvseg.tracking.config import Pots
from mvseg.tracking.growth import measure_growth
from mvseg.tracking.numbers import PAGE
from mvseg.tracking.page import PAGE_FILE, write_index, write_page
from mvseg.tracking.recorded import PlantResults, find_plant_links
from mvseg.tracking.tables import join_tables, write_track_tables
from mvseg.tracking.track import track_leaves
from mvseg.traits.table import read_csv


@dataclass(frozen=True)
class TrackedPlant:
    """Summary of a plant once its tables and pages are written: counts, warnings; a sentence if it failed."""

    dates: int = 0
    tracks: int = 0
    days: float = 0.0  # from the first date to the last
    warnings: tuple[str, ...] = ()
    sentence: str = ""


def list_plants(batch: Path) -> tuple[list[PlantResults], int]:
    """The plants of a batch with two finished dates or more, in the order of its table, and how many have fewer. Raises
    InputError if `batch` is not the --out of a finished batch, its table is broken, or no plant has two dates."""
    scenes: dict[str, list[tuple[str, str]]] = {}
    path = batch / TABLES / "summary.csv"
    if not path.is_file():
        raise InputError(f"{batch}: is not an output of mvseg batch ({TABLES}/summary.csv is missing)")
    for row in read_csv(path, ("scene", "plant", "time", "state")):
        if row["state"] == "done":
            scenes.setdefault(row["plant"], []).append((row["scene"], row["time"]))
    dated = {plant: list(zip(*of, strict=True)) for plant, of in scenes.items() if len(of) > 1}
    plants = [PlantResults(plant=plant, results=tuple(map(batch.joinpath, names)), times=times)
              for plant, (names, times) in dated.items()]  # fmt: skip
    if not plants:
        message = "no plant has two finished dates, expected a table with columns plant and time (docs/batch.md)"
        raise InputError(f"{batch}: {message}")
    return plants, len(scenes) - len(plants)


def track_plants(
    plants: Sequence[PlantResults],
    out: Path,
    *,
    corrections: Path | None = None,
    pots: Pots = "auto",
    num_workers: int = 1,
    report: bool = True,
) -> list[TrackedPlant]:
    """Track plants and write the folder `out`, whole or not at all; an earlier one is replaced. One plant is in memory
    at a time in each process. A plant that fails has a `sentence`; the others continue.

    Args:
        out: the tables of `write_track_tables`, tracks.html and run.json; of several plants, the pages lie in
            `plants/`, and tracks.html is their list.
        num_workers: processes, >= 1; with one, and one plant, everything happens in this one.

    Raises InputError: `out` cannot be written, or holds something else or tracks of other results; the corrections are
    broken, or every plant failed.
    """
    edits = () if corrections is None else load_corrections(corrections).edits
    record: dict[str, Any] = {}
    folders = tuple(folder for plant in plants for folder in plant.results)
    output = Output("tracks", of=folders, reads=() if corrections is None else (corrections,))
    with replace_result(out, record, output) as folder:
        places = [folder / "plants" / f"{number:05d}" for number in range(1, len(plants) + 1)]
        places = places if len(plants) > 1 else [folder]
        work = partial(_track_plant, edits, pots=pots, report=report)
        items = dict(enumerate(zip(plants, places, strict=True)))
        answers: Generator[tuple[int, TrackedPlant | Lost], None, None]
        answers = ((index, work(item)) for index, item in items.items())
        if (number := min(num_workers, len(items))) != 1:
            answers = run_locally(work, items, int, num_workers=number)
        with closing(answers):
            done = dict(progress_bar(answers, total=len(plants), name="track", unit="plant"))
        for index, answer in done.items():
            if isinstance(answer, Lost):
                sentence = f"{plants[index].plant}: the process that worked on it {answer.reason}"
                done[index] = TrackedPlant(sentence=sentence)
        tracked = [done[index] for index in items]
        if all(plant.sentence for plant in tracked):
            raise InputError(tracked[0].sentence)
        if len(plants) > 1:
            join_tables(folder, places)
            if report:
                pairs = zip(plants, tracked, strict=True)
                write_index(folder / PAGE_FILE, [(plant.plant, each.dates, each.tracks) for plant, each in pairs])
            else:
                shutil.rmtree(folder / "plants")
        record |= _describe_run(plants, tracked, corrections, pots)
    return tracked


def _track_plant(edits: Sequence[Edit], item: tuple[PlantResults, Path], *, pots: Pots, report: bool) -> TrackedPlant:
    plant, place = item
    try:
        dates = plant.read(pictures=PAGE.side if report else 0)
        links, lost = find_plant_links(edits, dates)
        tracks = track_leaves(dates, links=links, pots=pots, plant=plant.plant)
    except InputError as error:
        return TrackedPlant(sentence=f"plant {plant.plant}: {error}")
    growth = measure_growth(tracks)
    place.mkdir(parents=True, exist_ok=True)
    write_track_tables(place, tracks, growth)
    if report:
        write_page(place, tracks, growth)
    warnings = tuple(f"plant {plant.plant}: {sentence}" for sentence in (*tracks.findings, *lost.values()))
    days = tracks.dates[-1].time - tracks.dates[0].time
    return TrackedPlant(dates=len(tracks.dates), tracks=tracks.num_tracks, days=days, warnings=warnings)


def _describe_run(
    plants: Sequence[PlantResults], tracked: Sequence[TrackedPlant], corrections: Path | None, pots: Pots
) -> dict[str, Any]:
    inputs = [place / RUN_FILE for plant in plants for place in plant.results]  # which list the hashes of all files
    if corrections is not None:
        inputs.append(corrections)
    return {
        **made_by(),
        "inputs": {str(path): hash_files(path) if path.is_file() else None for path in inputs},
        "config": {"corrections": None if corrections is None else str(corrections.resolve()), "pots": pots,
                   "plants": [{**dict(each), "results": [path.resolve() for path in each.results]} for each in plants]},
        "warnings": [sentence for plant in tracked for sentence in plant.warnings],
        "failures": [plant.sentence for plant in tracked if plant.sentence],
        "counts": {"plants": len(plants), "dates": sum(plant.dates for plant in tracked),
                   "tracks": sum(plant.tracks for plant in tracked)},
    }  # fmt: skip
