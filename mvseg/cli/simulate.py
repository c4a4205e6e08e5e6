"""Render plants with ground truth."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.errors import InputError


def add_options(parser: ArgumentParser) -> None:
    presets = (
        "paper-eval (144 scenes of 3 to 20 photos), train (888 of 9 photos), wild (108 of 9 photos) or series "
        "(plants on 8 dates each)"
    )
    parser.add_argument("preset", help=presets)
    parser.add_argument("--out", type=Path, required=True, help="folder for the scenes; finished ones are kept")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--num_workers", type=int, default=1, help="scenes rendered at once")
    parser.add_argument("--num_plants", type=int, default=6, help="number of plants of the preset series")


def run(args: Namespace) -> int:
    try:
        from mvseg.simulation.dataset import write_dataset
        from mvseg.simulation.series import draw_specs, write_series
    except ModuleNotFoundError as error:
        raise InputError(f"simulate needs {error.name}: pip install 'mvseg[simulate]'") from error
    if args.preset == "series":
        if args.num_plants < 1 or args.seed < 0:
            raise InputError(f"{args.num_plants} plants, seed {args.seed}: expected 1 or more and 0 or more")
        write_series(args.out, draw_specs(args.num_plants, seed=args.seed))
        return 0
    write_dataset(args.preset, args.out, seed=args.seed, num_workers=args.num_workers)
    return 0
