"""`mvseg infer`: ids in every view, shapes in 3D and traits, of one scene."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from mvseg.batch.one_scene import run_one_scene
from mvseg.cli.options import DEFAULT_OUT, add_matching_options, build_options, read_up
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.matching.config import MatchConfig
from mvseg.multiview.config import DetectConfig
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.traits.config import TraitsConfig


def add(verbs: Any) -> None:
    """Add the verb to the parser's sub-commands."""
    about = "Ids in every view, shapes in 3D and traits, of one scene."
    parser = ArgumentParser(exit_on_error=False, description=about)
    help_scene = "scene folder (photos, cameras of any kind in docs/formats.md); without it, the plant that ships"
    parser.add_argument("scene", nargs="?", type=Path | None, help=help_scene)
    add_matching_options(parser, masks=None)
    parser.add_class_arguments(DetectConfig, "detect")
    parser.add_class_arguments(ReconstructConfig, "reconstruct")
    parser.add_class_arguments(TraitsConfig, "traits")
    help_scale = "multiplies the world's lengths, for cameras without a scale"
    parser.add_argument("--scale", type=float | None, help=help_scale)
    help_unit = "name of the world's unit, after --scale (default: the scene's)"
    parser.add_argument("--unit", type=str | None, help=help_unit)
    help_up = "which way is up: X Y Z, 'rig' (level cameras) or 'board' (flat ArUco markers); default: the scene's own"
    parser.add_argument("--up", type=str | list[float] | None, help=help_up)
    help_rims = "draw the rims of the surfaces, as the cameras see them, into overlay/"
    parser.add_argument("--draw_rims", type=bool, default=True, help=help_rims)
    verbs.add_subcommand("infer", parser, help="ids and 3D shapes of one scene")


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    if args.scene is None:
        print("mvseg: no SCENE given: this is the plant that ships with mvseg", file=sys.stderr)
    scene = args.scene or demo_scene()
    out = args.out or DEFAULT_OUT / scene.resolve().name
    config = RunConfig(
        detect=build_options(DetectConfig, args.detect, "detect."),
        match=build_options(MatchConfig, args.match, "match."),
        reconstruct=build_options(ReconstructConfig, args.reconstruct, "reconstruct."),
        traits=build_options(TraitsConfig, args.traits, "traits."),
        scale=args.scale,
        unit=args.unit,
        up=read_up(args.up),
        split_merged=args.split_merged,
        draw_rims=args.draw_rims,
        report=args.report,
        coco_crowd=args.coco_crowd,
        categories=args.categories,
    )
    run_one_scene(scene, args.masks, out, config=config, quiet=args.quiet)
    return 0
