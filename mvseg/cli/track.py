"""The same leaf over days: tracks, growth, births and deaths; see docs/tracking.md."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import add_shared
from mvseg.errors import InputError
from mvseg.system.say import say
from mvseg.tracking.config import Pots

if TYPE_CHECKING:
    from mvseg.tracking.recorded import RecordedTracks

SOME_FAILED = 3  # definition: exit code where some plants failed
LEAST_NAME = 4  # chosen: characters of a plant's name; "day" is none


def add_options(parser: ArgumentParser) -> None:
    help_results = "output of mvseg batch (every plant with two dates or more), or the results of one plant"
    parser.add_argument("results", type=Path, nargs="*", help=help_results)
    help_again = "tracks to make anew, as they were made, or with other --corrections"
    parser.add_argument("--again", type=Path | None, help=help_again)
    help_times = "of each result: numbers (days) or ISO dates (2026-05-31 or 20260531)"
    parser.add_argument("--times", type=str, nargs="+", help=help_times)
    help_plant = "name of the plant, with --times (default: what the names of its results begin with)"
    parser.add_argument("--plant", type=str | None, help=help_plant)
    parser.add_argument("--out", type=Path | None, help="folder for tables and pages (--again: the same)")
    help_pots = "fixed (they stand as they stood), turned (any turn is as likely as none), or auto (few are)"
    parser.add_argument("--pots", type=Pots, default="auto", help=help_pots)
    help_corrections = "file with same_track and different_track, see docs/tracking.md"
    parser.add_argument("--corrections", type=Path | None, help=help_corrections)
    parser.add_argument("--report", type=bool, default=True, help="write tracks.html")
    parser.add_argument("--num_workers", type=int, default=1, help="plants tracked at once, each in its own process")
    add_shared(parser, "quiet")


def run(args: Namespace) -> int:
    from mvseg.batch.track_plants import track_plants  # keeps --help quick
    from mvseg.tracking.page import PAGE_FILE

    asked = _read_again(args) if args.again is not None else _read_results(args)
    edits, options = args.corrections or asked.corrections, {name: args[name] for name in ("num_workers", "report")}
    tracked = track_plants(asked.plants, asked.folder, corrections=edits, pots=asked.pots, **options)
    for plant in tracked:
        for sentence in plant.warnings:
            say(f"mvseg: warning: {sentence}", to_stderr=True)
    failed = [plant.sentence for plant in tracked if plant.sentence]
    for sentence in failed:
        say(f"mvseg: {sentence}", to_stderr=True)
    num_dates, num_tracks = sum(plant.dates for plant in tracked), sum(plant.tracks for plant in tracked)
    done = len(tracked) - len(failed)
    longest = max(plant.days for plant in tracked)
    span = f"{longest:.3g} {'day' if longest == 1 else 'days'} apart{' at most' if num_dates > 2 else ''}"
    what = f"{num_tracks} leaves of {done} {'plant' if done == 1 else 'plants'}"
    say(f"{asked.folder}: {what} on {num_dates} dates, {span}")
    if args.report and done:
        say(f"mvseg: look at: {asked.folder / PAGE_FILE}")
    return SOME_FAILED if failed else 0


def _read_again(args: Namespace) -> RecordedTracks:
    from mvseg.system.atomic import sweep_abandoned
    from mvseg.tracking.recorded import read_recorded_tracks

    if args.results or args.times or args.plant or args.pots != "auto":
        message = f"--again repeats the run of {args.again} with its results, times and pots"
        raise InputError(f"{message}, expected no others")
    sweep_abandoned(args.again)
    return read_recorded_tracks(args.again).model_copy(update={"folder": args.out or args.again})


def _read_results(args: Namespace) -> RecordedTracks:
    from mvseg.batch.track_plants import list_plants
    from mvseg.tracking.recorded import PlantResults, RecordedTracks

    results, times, out = args.results, args.times, args.out
    if not results:
        raise InputError("no results are given, expected an output of mvseg batch, or results with --times")
    if out is None:
        raise InputError("--out is not given, expected a folder for the tables and pages")
    if times is None:
        if len(results) > 1:
            raise InputError(f"{len(results)} results are given without --times, expected one time for each")
        plants, num_single = list_plants(results[0])
        if num_single:
            say(f"mvseg: {num_single} plants have one date and are left out", to_stderr=True)
    else:
        if len(times) != len(results):
            raise InputError(f"{len(results)} results have {len(times)} times, expected one for each")
        name = args.plant or _name_plant(results) or out.resolve().name
        plants = [PlantResults(plant=name, results=tuple(results), times=tuple(times))]
    return RecordedTracks(folder=out, plants=tuple(plants), pots=args.pots)


def _name_plant(results: Sequence[Path]) -> str:
    """Common beginning of the names of all results, without a date; that of their scenes where it is short."""
    from mvseg.results.run_record import load_run

    with suppress(InputError):  # no results: whoever reads them says so
        for names in ([path.resolve().name for path in results], [Path(load_run(path).scene).name for path in results]):
            shared = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
            name = "".join(letters[0] for letters in shared).rstrip("0123456789-_. ")
            if len(name) >= LEAST_NAME:
                return name
    return ""
