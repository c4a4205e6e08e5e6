"""Ids only, of any number of scenes."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.complain import complain
from mvseg.cli.options import DEFAULT_OUT, OF_REQUEST, add_matching_options, add_shared, build_options
from mvseg.config import RunConfig
from mvseg.errors import InputError
from mvseg.matching.config import MatchConfig


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="+", type=Path, help="scene folders")
    add_matching_options(parser, masks=Path("masks"))
    add_shared(parser, *OF_REQUEST)


def run(args: Namespace) -> int:
    from mvseg.formats.photos import scene_name  # keeps --help and wrong options quick
    from mvseg.runs.one_scene import run_one_scene
    from mvseg.runs.request import RunRequest

    names = [scene_name(scene) for scene in args.scenes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two scenes are called '{name}', expected different names: each names a folder in --out")
    if args.masks is None:
        raise InputError("masks is null, expected the masks to match; use mvseg infer to detect them in the photos")
    code, out = 0, args.out or DEFAULT_OUT
    plain = {name: args[name] for name in ("report", "coco_crowd", "categories")}
    shared = {name: args[name] for name in OF_REQUEST}
    config = RunConfig(views="all", match=build_options(MatchConfig, args.match, "match."), reconstruct=None, **plain)
    for scene, name in zip(args.scenes, names, strict=True):
        try:
            run_one_scene(RunRequest(scene, args.masks, out / name, config, **shared))
        except InputError as error:  # the other scenes still get their results
            code = complain(error)
    return code
