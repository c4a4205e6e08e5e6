"""Ids in every view, shapes in 3D and traits, of one scene."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import DEFAULT_OUT, OF_REQUEST, add_run_options, add_shared, build_run
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.errors import InputError
from mvseg.system.running import now_running
from mvseg.system.say import say, show_line

if TYPE_CHECKING:
    from mvseg.runs.request import RunRequest


def add_options(parser: ArgumentParser) -> None:
    help_scene = "scene folder (photos, cameras of any kind in docs/formats.md); without it, the plant that ships"
    parser.add_argument("scene", nargs="?", type=Path | None, help=help_scene)
    help_again = "repeat the run that made this result, with its options and, if given, with other --corrections"
    parser.add_argument("--again", type=Path | None, help=help_again)
    help_detector = "with --again: weights that have learned this plant, in place of those of the run"
    parser.add_argument("--detector", type=Path | None, help=help_detector)
    add_run_options(parser)
    add_shared(parser, *OF_REQUEST, "num_workers")


def run(args: Namespace) -> int:
    if now_running().progress and sys.stderr.isatty():
        show_line("mvseg: starting")  # the imports take seconds
    from mvseg.formats.photos import scene_name  # keeps --help and wrong options quick
    from mvseg.runs.one_scene import run_one_scene
    from mvseg.runs.request import RunRequest
    from mvseg.system.worker_pool import default_workers

    num_workers = default_workers() if args.num_workers is None else args.num_workers
    if args.again is not None:
        run_one_scene(_request_again(args), num_workers=num_workers)
        return 0
    if args.detector is not None:
        raise InputError("--detector is of --again; the weights of a new run are --detect.weights")
    if args.scene is None:
        say("mvseg: no SCENE given: this is the plant that ships with mvseg", to_stderr=True)
    scene = args.scene or demo_scene()
    out, shared = args.out or DEFAULT_OUT / scene_name(scene), {name: args[name] for name in OF_REQUEST}
    run_one_scene(RunRequest(scene, args.masks, out, build_run(args), **shared), num_workers=num_workers)
    return 0


def _request_again(args: Namespace) -> RunRequest:
    from mvseg.results.read import find_result
    from mvseg.runs.request import repeat_run
    from mvseg.system.atomic import sweep_abandoned

    learn = build_run(args).learn
    if args.scene is not None or args.masks is not None or build_run(args) != RunConfig(learn=learn):
        raise InputError(
            f"--again repeats the run of {args.again} with its options, expected no scene, no masks and no other "
            "options than --learn, --detector, --corrections, --force_corrections, --out, --overwrite, --num_workers "
            "and --quiet"
        )
    sweep_abandoned(args.again)
    options = {name: args[name] for name in ("out", "detector", "corrections")}
    request = repeat_run(find_result(args.again), learn=None if learn == "auto" else learn, **options)
    return replace(request, force_corrections=args.force_corrections, overwrite=args.overwrite)
