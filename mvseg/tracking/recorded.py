"""Results from which a folder of tracks was made, by its run.json, so that they can be tracked again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, model_validator

from mvseg.corrections.file import Edit
from mvseg.corrections.track_links import LeafLink, find_links
from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.results.earlier import RUN_FILE
from mvseg.system.atomic import wait_until_whole
from mvseg.tracking.config import Pots
from mvseg.tracking.dates import PlantOnDate, name_apart, read_date


class PlantResults(BaseModel, frozen=True):
    """One plant to track: its name, its result folders and their times as the user gave them."""

    plant: str
    results: tuple[Path, ...]
    times: tuple[str, ...]

    @model_validator(mode="after")
    def _as_many(self) -> PlantResults:
        if len(self.results) != len(self.times):
            raise ValueError(f"{len(self.times)} times for {len(self.results)} results, expected one for each")
        return self

    def read(self, *, pictures: int) -> list[PlantOnDate]:
        """Its dates, those with results of one name told apart; for `pictures` see `read_date`. Raises InputError: see
        `read_date`; or one has no time."""
        dated = list(zip(self.results, self.times, strict=True))
        missing = [folder.name for folder, time in dated if not time]
        if missing:
            raise InputError(f"{missing[0]} has no time, expected a number (days) or an ISO date (column time)")
        return name_apart([read_date(folder, time, pictures=pictures) for folder, time in dated])


class RecordedTracks(BaseModel, frozen=True):
    """The run of `mvseg track` that made a folder.

    Attributes:
        plants: in their order; the results are where they are now, if they moved together with the tracks.
        corrections: the file of links that were given, if it is still there.
    """

    folder: Path = Path()
    plants: tuple[PlantResults, ...] = ()
    pots: Pots = "auto"
    corrections: Path | None = None


class _Output(BaseModel):
    kind: Literal["tracks"]
    of: dict[str, str | None]


class _Run(BaseModel):
    config: RecordedTracks
    output: _Output | None = None


def find_plant_links(edits: Sequence[Edit], dates: Sequence[PlantOnDate]) -> tuple[list[LeafLink], dict[int, str]]:
    """Links of the user between leaves of a plant, and problems of single edits, see `find_links`."""
    folders = {date.scene: date.folder for date in dates if date.folder is not None}
    return find_links(edits, folders, {(date.scene, date.leaves[n].leaf) for date in dates for n in date.shaped})


def is_tracks(folder: Path) -> bool:
    return (folder / "tracks.csv").is_file() and (folder / RUN_FILE).is_file()


def read_recorded_tracks(folder: Path) -> RecordedTracks:
    """The run that made a folder of tracks. Raises InputError: these are no tracks, or those of a version that did not
    record their results; a result is gone."""
    wait_until_whole(folder)
    if not is_tracks(folder):
        raise InputError(f"{folder}: holds no tracks.csv and {RUN_FILE}, expected the output of mvseg track")
    record = read_json(folder / RUN_FILE, _Run)
    if not record.config.plants or record.output is None:
        message = "an earlier version made these tracks, and did not say of which results and times"
        raise InputError(f"{folder}: {message}; expected those of mvseg track of this version")
    from_here = record.output.of

    def find(stated: Path) -> Path:
        moved = from_here.get(str(stated))
        place = stated if stated.is_dir() or moved is None else (folder / moved).resolve()
        if not place.is_dir():
            raise InputError(f"{stated}: the result that {folder} was made of is gone, expected it there")
        return place

    config = record.config
    plants = tuple(each.model_copy(update={"results": tuple(map(find, each.results))}) for each in config.plants)
    corrections = config.corrections if config.corrections is not None and config.corrections.is_file() else None
    return config.model_copy(update={"folder": folder, "plants": plants, "corrections": corrections})
