"""`python -m benchmarks.paper_tables [--preset small|paper] [--cache DIR] ...`: run what is missing, write it up.

The scenes, and one record per scene and method, are kept in the cache folder; the same command goes on after an
interruption, and writes up what is there with --write_only.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks.paper_tables.cells import PRESETS, list_cells
from benchmarks.paper_tables.experiments import TABLES, Plan, run_real, run_simulated
from benchmarks.paper_tables.methods import METHODS
from benchmarks.paper_tables.shapes import SHAPES
from benchmarks.paper_tables.workers import run_all


def main(argv: Sequence[str] | None = None) -> None:
    parser = build_parser()
    args = parser.parse_args(argv)
    names = [folder.resolve().name for folder in args.real]
    if len(set(names)) < len(names):
        parser.error("two real scenes have the same name")
    plan = Plan(
        preset=args.preset,
        cache=args.cache,
        tables=tuple(name for name in TABLES if name in args.tables),
        methods=tuple(name for name in METHODS if name in args.methods),
        shapes=tuple(name for name in SHAPES if name in args.shapes),
        shape_plants=args.shape_plants,
        detector=args.detector,
        real=tuple(args.real),
    )
    if not args.write_only:
        work = partial(run_simulated, plan=plan)
        run_all(work, list_cells(PRESETS[plan.preset]), args.num_workers, "simulated scenes")
        if "2" in plan.tables:
            run_all(partial(run_real, plan=plan), plan.real, args.num_workers, "real scenes")
    from benchmarks.paper_tables.write_up import write_up

    default = Path("docs") if plan.preset == "paper" else plan.cache / "docs"
    print(write_up(plan, args.out or default))


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper_tables",
        description="The paper's tables 1 to 3 and the question of |k|, on simulated test plants and real scenes.",
    )
    parser.add_argument("--preset", choices=list(PRESETS), default="small", help="small: 4 scenes, minutes; paper: 48")
    parser.add_argument("--cache", type=Path, default=Path("results/paper_tables"), help="folder for all that is kept")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES)
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), metavar="METHOD")
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES), metavar="SHAPE")
    parser.add_argument("--shape_plants", type=int, default=1, help="plants per number of leaves in table 3")
    parser.add_argument("--num_workers", type=int, default=1, help="scenes at once")
    parser.add_argument("--detector", help="match the masks of this detector too: a name of the zoo or a weights file")
    parser.add_argument("--real", "--basil", nargs="+", type=Path, default=[], help="real scene folders for table 2")
    parser.add_argument("--out", type=Path, help="folder for benchmarks.md and its plots (docs; small: CACHE/docs)")
    parser.add_argument("--write_only", action="store_true", help="run nothing, write up the records that are there")
    return parser


if __name__ == "__main__":
    main()
