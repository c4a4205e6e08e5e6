"""Ids in every view, shapes in 3D and traits, of one scene."""

from __future__ import annotations

import sys
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import DEFAULT_OUT, add_run_options, add_shared, build_run
from mvseg.demo import demo_scene


def add_options(parser: ArgumentParser) -> None:
    """The options of the verb."""
    help_scene = "scene folder (photos, cameras of any kind in docs/formats.md); without it, the plant that ships"
    parser.add_argument("scene", nargs="?", type=Path | None, help=help_scene)
    add_run_options(parser)
    add_shared(parser, "corrections", "overwrite", "num_workers")


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    if args.scene is None:
        print("mvseg: no SCENE given: this is the plant that ships with mvseg", file=sys.stderr)
    scene = args.scene or demo_scene()
    from mvseg.formats.photos import scene_name  # keeps --help and wrong options quick
    from mvseg.runs.one_scene import run_one_scene
    from mvseg.system.worker_pool import default_workers

    out = args.out or DEFAULT_OUT / scene_name(scene)
    num_workers = default_workers() if args.num_workers is None else args.num_workers
    run_one_scene(
        scene,
        args.masks,
        out,
        config=build_run(args),
        corrections=args.corrections,
        num_workers=num_workers,
        overwrite=args.overwrite,
        quiet=args.quiet,
    )
    return 0
