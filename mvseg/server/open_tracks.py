"""Tracks that the user corrects: links between dates; each edit tracks the plant anew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvseg.corrections.file import Corrections, dump_edits, load_corrections, name_edits
from mvseg.corrections.track_links import LeafLink
from mvseg.errors import InputError
from mvseg.findings.finding import list_some
from mvseg.server.saved_edits import CORRECTIONS_FILE, Update
from mvseg.server.stable_numbers import give_numbers
from mvseg.system.running import Cancelled
from mvseg.tracking.growth import measure_growth
from mvseg.tracking.numbers import PAGE
from mvseg.tracking.page import build_tracks_page, describe_tracks
from mvseg.tracking.questions import Question, describe_changes, list_questions
from mvseg.tracking.recorded import PlantResults, RecordedTracks, find_plant_links, read_recorded_tracks
from mvseg.tracking.track import Tracks, track_leaves


class OpenTracks:
    """The folder of `mvseg track`, the run that made it, and the plant that is corrected; without answers, learner and
    notice."""

    learner, notice = None, ""

    def __init__(self, folder: Path, plant: str | None = None) -> None:
        """Read the results of the plant's dates. Raises InputError: see `read_recorded_tracks` and `track_leaves`;
        there is no such plant, or several and none is named."""
        self.folder, self.answers = folder, dict[str, Callable[[bytes], Mapping[str, Any]]]()
        self.recorded = read_recorded_tracks(folder)
        self.plant = _choose_plant(self.recorded, plant)
        self.dates = self.plant.read(pictures=PAGE.large_side)
        self._numbers: dict[tuple[int, int], int] = {}  # track that each (date, leaf) showed last
        self._page = self._track(self._links(self.read_edits()[0])[0])

    def read_edits(self) -> tuple[Corrections, str]:
        """The edits in the folder, or else those that the tracks were made with."""
        own, given = self.folder / CORRECTIONS_FILE, self.recorded.corrections
        path = own if own.is_file() else given
        found = Corrections() if path is None else load_corrections(path)
        self._photos = found.photos
        return found, self.notice

    def mark(self, corrections: Corrections) -> Corrections:
        """The edits, with the marks of photos in their file: those of single scenes there stay."""
        return replace(corrections, photos=self._photos)

    def page(self, corrections: Corrections) -> str:
        edits = {"edits": dump_edits(corrections.edits), "revision": name_edits(corrections.edits)}
        correct = {"key": "", "isServed": True, "photos": {}, "folder": str(self.folder.resolve())} | edits
        return build_tracks_page(self.plant.plant, self._page[1] | {"correct": correct})

    def updates(self, corrections: Corrections, is_old: Callable[[], bool]) -> Iterator[Update]:
        """The tracks with these edits; then, the effects of the answers to each question. Raises Cancelled: `is_old`
        said so; InputError: see `track_leaves`."""
        links, outcomes = self._links(corrections)
        self._page = tracks, data = self._track(links)
        yield Update(_without_pictures(data), outcomes, [])
        questions = []
        for question in list_questions(tracks, links):
            if is_old():
                raise Cancelled
            questions.append(_describe_question(question) | {"changes": self._changes(question, links)})
        data["questions"] = questions
        yield Update(_without_pictures(data), outcomes, [])

    def again(self, _: Path) -> list[str]:
        """`mvseg track --again`: the tables of all plants."""
        return ["track", "--again", str(self.folder.resolve())]

    def reopened(self) -> OpenTracks:
        return OpenTracks(self.folder, self.plant.plant)

    def _links(self, corrections: Corrections) -> tuple[list[LeafLink], list[str]]:
        links, problems = find_plant_links(corrections.edits, self.dates)
        return links, [problems.get(index, "") for index in range(len(corrections.edits))]

    def _track(self, links: Sequence[LeafLink]) -> tuple[Tracks, dict[str, Any]]:
        tracks = keep_track_numbers(self._track_with(links), self._numbers)
        data = describe_tracks(tracks, measure_growth(tracks))
        return tracks, data | {"questions": [_describe_question(each) for each in list_questions(tracks, links)]}

    def _track_with(self, links: Sequence[LeafLink]) -> Tracks:
        return track_leaves(self.dates, links=links, pots=self.recorded.pots, plant=self.plant.plant)

    def _changes(self, question: Question, links: Sequence[LeafLink]) -> list[str]:
        tracks, _ = self._page
        with suppress(InputError):  # it contradicts what was said before
            other = question.link(tracks, is_same=not question.is_linked)
            return describe_changes(tracks, self._track_with([*links, other]))
        return []


def keep_track_numbers(tracks: Tracks, number_of: dict[tuple[int, int], int]) -> Tracks:
    """Give tracks the numbers that most of their leaves had last, and the others new ones, see `give_numbers`.
    `number_of` learns those of (date, leaf)."""
    observed = {(row.date, row.leaf): row for row in tracks.rows if row.leaf is not None}
    votes = Counter[tuple[int, int]]()
    for leaf in observed.keys() & number_of.keys():
        votes[observed[leaf].track, number_of[leaf]] += 2 * len(tracks.dates) - leaf[0]  # of one and one, the earlier
    numbers = give_numbers(votes, {row.track for row in tracks.rows}, number_of.values())
    number_of.update({leaf: numbers[row.track] for leaf, row in observed.items()})
    rows = (replace(row, track=numbers[row.track]) for row in tracks.rows)
    return replace(tracks, rows=tuple(sorted(rows, key=lambda row: (row.date, row.track))))


def _choose_plant(recorded: RecordedTracks, name: str | None) -> PlantResults:
    plants = [each for each in recorded.plants if name in (None, each.plant)]
    if len(plants) == 1:
        return plants[0]
    names = list_some([each.plant for each in recorded.plants])
    what = f"holds {len(plants)} plants" if name is None else f"holds no plant {name}"
    raise InputError(f"{recorded.folder}: {what}, expected one of {names} with --plant")


def _describe_question(question: Question) -> dict[str, Any]:
    return {"before": question.before, "after": question.after, "isLinked": question.is_linked,
            "doubt": round(question.doubt, 3), "changes": None}  # fmt: skip


def _without_pictures(data: Mapping[str, Any]) -> dict[str, Any]:
    leaves = [{k: v for k, v in leaf.items() if k not in ("crop", "place")} for leaf in data["leaves"]]
    return {**data, "leaves": leaves}
