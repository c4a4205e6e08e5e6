"""Many scenes, one after another or side by side, and their traits in one table; see docs/batch.md."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import DEFAULT_OUT, add_run_options, add_shared, build_run, read_workers
from mvseg.system.say import say

SOME_FAILED = 3  # definition: exit code where some scenes failed


def add_options(parser: ArgumentParser) -> None:
    help_scenes = "CSV table (columns scene, and if you like name, masks, plant, time, ...), or folder of scene folders"
    parser.add_argument("scenes", type=Path, help=help_scenes)
    add_run_options(parser)
    help_resume = "continue the batch in --out: results of the same inputs and options are kept"
    parser.add_argument("--resume", type=bool, default=False, help=help_resume)
    help_workers = "scenes worked on at once, each in a process of its own on one thread (default: 1)"
    parser.add_argument("--num_workers", type=int | None, help=help_workers)
    add_shared(parser, "scheduler")


def run(args: Namespace) -> int:
    from mvseg.batch.run_batch import run_batch  # keeps --help and wrong options quick
    from mvseg.formats.photos import scene_name

    out = args.out or DEFAULT_OUT / Path(scene_name(args.scenes)).stem
    options = {name: args[name] for name in ("masks", "resume", "scheduler")}
    counts = run_batch(args.scenes, out, build_run(args), num_workers=read_workers(args), **options)
    total, tables = counts.done + counts.failed, out / "tables"
    if counts.warned:
        some = f"{counts.warned} of {counts.done} scenes have warnings"
        say(f"mvseg: warning: {some}, see {tables / 'summary.csv'}", to_stderr=True)
    if counts.failed:
        say(f"mvseg: {counts.failed} of {total} scenes failed, see {tables / 'failures.csv'}", to_stderr=True)
    kept = f" ({counts.resumed} of them before)" if counts.resumed else ""
    say(f"{out}: {counts.done} of {total} scenes are done{kept}")
    return SOME_FAILED if counts.failed else 0
