"""Many scenes, one after another or side by side, and their traits in one table; see docs/batch.md."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import DEFAULT_OUT, add_run_options, build_run
from mvseg.errors import InputError
from mvseg.system.say import say

SOME_FAILED = 3  # definition: exit code where some scenes failed


def add_options(parser: ArgumentParser) -> None:
    help_scenes = "CSV table (columns scene, and if you like name, masks, plant, time, ...), or folder of scene folders"
    parser.add_argument("scenes", type=Path, help=help_scenes)
    add_run_options(parser)
    help_resume = "continue the batch in --out: results of the same inputs and options are kept"
    parser.add_argument("--resume", type=bool, default=False, help=help_resume)
    help_workers = "scenes worked on at once, each in a process of its own on one thread (default: 1)"
    parser.add_argument("--num_workers", type=int, default=1, help=help_workers)
    help_part = "K/N: every N-th scene from the K-th on, for jobs of a cluster; without the tables (docs/batch.md)"
    parser.add_argument("--part", type=str | None, help=help_part)


def run(args: Namespace) -> int:
    from mvseg.batch.run_batch import run_batch  # keeps --help and wrong options quick
    from mvseg.formats.photos import scene_name

    out = args.out or DEFAULT_OUT / Path(scene_name(args.scenes)).stem
    options = {name: args[name] for name in ("masks", "resume", "num_workers")}
    counts = run_batch(args.scenes, out, build_run(args), part=_read_part(args.part), **options)
    total, tables = counts.done + counts.failed, out / "tables"
    if counts.warned and args.part is None:
        some = f"{counts.warned} of {counts.done} scenes have warnings"
        say(f"mvseg: warning: {some}, see {tables / 'summary.csv'}", to_stderr=True)
    if counts.failed and args.part is None:
        say(f"mvseg: {counts.failed} of {total} scenes failed, see {tables / 'failures.csv'}", to_stderr=True)
    kept = f" ({counts.resumed} of them before)" if counts.resumed else ""
    say(f"{out}: {counts.done} of {total} scenes are done{kept}")
    return SOME_FAILED if counts.failed else 0


def _read_part(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    try:
        first, number = map(int, text.split("/"))
    except ValueError:
        raise InputError(f"--part is '{text}', expected K/N, as 3/20") from None
    return first, number
