"""Estimate the cameras of photos or of a video: a scene folder for mvseg infer, from these alone."""

from __future__ import annotations

import math
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import CheckedConfig, add_shared, build_options, read_up
from mvseg.errors import InputError
from mvseg.formats.board import BoardConfig
from mvseg.poses.config import PoseConfig, WorldFacts


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("photos", type=Path, help="folder of photos, or of one such folder per camera; or a video")
    parser.add_argument("--out", type=Path, required=True, help="the scene folder")
    parser.add_argument("--config", action=CheckedConfig, help="YAML file with any of these options")
    add_shared(parser, "quiet")
    parser.add_class_arguments(PoseConfig)
    help_board = "scale and axes from a printed ChArUco board: --board.columns, --board.rows, --board.square, ..."
    parser.add_argument("--board", type=BoardConfig | None, help=help_board)
    help_marker = "scale from printed ArUco or AprilTag markers with sides (of the black squares) of this length"
    parser.add_argument("--marker", type=float | None, help=help_marker)
    help_distance = (
        "scale from the distance of two cameras (names of photos), markers (as marker:7) or spots that two photos show "
        "(as a.jpg:812,455+b.jpg:790,470, pixels): A B LENGTH"
    )
    parser.add_argument("--distance", nargs=3, type=str, metavar=("A", "B", "LENGTH"), help=help_distance)
    help_positions = "scale and axes from camera positions: CSV with photo,x,y,z, or JSON"
    parser.add_argument("--positions", type=Path | None, help=help_positions)
    parser.add_argument("--unit", type=str | None, help="name of the unit of these lengths (mm, m, ...)")
    add_shared(parser, "up")
    help_turntable = (
        "photos from a turntable with fixed cameras: 'board' calibrates it from photos of --board on the table; the "
        "turntable.json that this writes gives the cameras for photos of a plant"
    )
    parser.add_argument("--turntable", type=str | None, help=help_turntable)
    help_angles = (
        "with a turntable.json: the angles of the plant's photos, if they differ from those of the calibration: CSV "
        "with photo,angle, or the degrees from one photo to the next"
    )
    parser.add_argument("--angles", type=float | Path | None, help=help_angles)


def run(args: Namespace) -> int:
    board = None if args.board is None else BoardConfig(**vars(args.board))
    world = WorldFacts(board, args.marker, _read_distance(args.distance), args.positions, unit=args.unit or "")
    config = build_options(PoseConfig, args)
    if args.turntable in (None, "board") and args.angles is not None:
        raise InputError("--angles has no effect without --turntable and a turntable.json")
    if args.turntable is not None:
        _run_turntable(args, world, config)
        return 0
    from mvseg.runs.pose_photos import pose_photos  # keeps --help and wrong options quick

    pose_photos(args.photos, args.out, config=config, world=world, up=read_up(args.up))
    return 0


def _run_turntable(args: Namespace, world: WorldFacts, config: PoseConfig) -> None:
    from mvseg.runs.pose_turntable import pose_board_photos, pose_turntable_photos

    is_board = args.turntable == "board"
    used = ("marker", "distance", "positions") if is_board else ("board", "marker", "distance", "positions", "unit")
    useless = [name for name in used if getattr(world, name)] + (["up"] if args.up is not None else [])
    if config != PoseConfig(calibration=config.calibration if is_board else None):
        useless.append("the options of structure from motion")
    if useless:
        raise InputError(f"{', '.join(useless)}: no effect with --turntable {args.turntable}, expected none of them")
    if not is_board:
        if isinstance(args.angles, float) and not math.isfinite(args.angles):
            raise InputError(f"angles is {args.angles}, expected degrees or a CSV file")
        pose_turntable_photos(args.photos, args.out, turntable=Path(args.turntable), angles=args.angles)
    elif world.board is None:
        raise InputError("--turntable board needs the board: --board.columns, .rows, .square and .marker")
    else:
        pose_board_photos(args.photos, args.out, board=world.board, unit=world.unit, calibration=config.calibration)


def _read_distance(words: list[str] | None) -> tuple[str, str, float] | None:
    if words is None:
        return None
    if len(words) != 3:
        raise InputError(f"distance has {len(words)} words, expected two photos or markers, and a length")
    first, second, length = words
    try:
        return first, second, float(length)
    except ValueError:
        raise InputError(f"distance: '{length}' is not a length, expected --distance A B LENGTH") from None
