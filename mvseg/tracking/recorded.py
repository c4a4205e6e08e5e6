"""Results from which a folder of tracks was made, by its run.json, so that they can be tracked again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mvseg.corrections.file import Edit
from mvseg.corrections.track_links import LeafLink, find_links
from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.results.earlier import RUN_FILE
from mvseg.system.atomic import wait_until_whole
from mvseg.tracking.config import Pots
from mvseg.tracking.dates import PlantOnDate, name_apart, read_date


@dataclass(frozen=True)
class PlantResults:
    """One plant to track: its name, its result folders and their times as the user gave them."""

    plant: str
    folders: tuple[Path, ...]
    times: tuple[str, ...]

    def read(self, *, pictures: int) -> list[PlantOnDate]:
        """Its dates, those with results of one name told apart; for `pictures` see `read_date`. Raises InputError: see
        `read_date`; or one has no time."""
        dated = list(zip(self.folders, self.times, strict=True))
        missing = [folder.name for folder, time in dated if not time]
        if missing:
            raise InputError(f"{missing[0]} has no time, expected a number (days) or an ISO date (column time)")
        return name_apart([read_date(folder, time, pictures=pictures) for folder, time in dated])


@dataclass(frozen=True)
class RecordedTracks:
    """The run of `mvseg track` that made a folder.

    Attributes:
        plants: in their order; the results are where they are now, if they moved together with the tracks.
        pots: see `track_leaves`.
        corrections: the file of links that were given, if it is still there.
    """

    folder: Path
    plants: tuple[PlantResults, ...]
    pots: Pots
    corrections: Path | None


class _Part(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore")


class _Plant(_Part):
    plant: str
    results: tuple[str, ...]
    times: tuple[str, ...]

    @model_validator(mode="after")
    def _as_many(self) -> _Plant:
        if len(self.results) != len(self.times):
            raise ValueError(f"{len(self.times)} times for {len(self.results)} results, expected one for each")
        return self


class _Config(_Part):
    plants: tuple[_Plant, ...] = ()
    pots: Pots = "auto"
    corrections: str | None = None


class _Output(_Part):
    kind: Literal["tracks"]
    of: dict[str, str | None]


class _Run(_Part):
    config: _Config
    output: _Output | None = Field(None)


def record_plants(plants: Sequence[PlantResults]) -> list[dict[str, Any]]:
    """Entries of run.json about them, with absolute paths."""
    return [
        {"plant": each.plant, "results": [str(path.resolve()) for path in each.folders], "times": list(each.times)}
        for each in plants
    ]


def find_plant_links(edits: Sequence[Edit], dates: Sequence[PlantOnDate]) -> tuple[list[LeafLink], dict[int, str]]:
    """Links of the user between leaves of a plant, and problems of single edits, see `find_links`."""
    folders = {date.scene: date.folder for date in dates if date.folder is not None}
    return find_links(edits, folders, {(date.scene, date.leaves[n].leaf) for date in dates for n in date.shaped})


def is_tracks(folder: Path) -> bool:
    """Whether a folder was written by `mvseg track`."""
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

    def find(stated: str) -> Path:
        moved = from_here.get(stated)
        places = [Path(stated), *([] if moved is None else [(folder / moved).resolve()])]
        found = next((place for place in places if place.is_dir()), None)
        if found is None:
            raise InputError(f"{stated}: the result that {folder} was made of is gone, expected it there")
        return found

    listed = record.config.plants
    plants = tuple(PlantResults(each.plant, tuple(map(find, each.results)), each.times) for each in listed)
    stated = record.config.corrections
    corrections = Path(stated) if stated is not None and Path(stated).is_file() else None
    return RecordedTracks(folder, plants, record.config.pots, corrections)
