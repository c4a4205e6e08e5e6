"""`python -m benchmarks.paper_tables [--preset small|paper] [--cache DIR] ...`: run what is missing, print the tables.

The paper's tables 1 to 3 and the question of |k|, on simulated test plants and real scenes. The scenes, and one record
per scene and method, are kept in the cache folder. After an interruption the same command goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.paper_tables.cells import PRESETS, list_cells
from benchmarks.paper_tables.experiments import TABLES, Plan, run_real, run_simulated
from benchmarks.paper_tables.tables import print_tables
from mvseg.system.worker_pool import run_all


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
        detector=args.detector,
        real=tuple(args.real),
    )
    torch.set_num_threads(1)
    run_scenes(partial(run_simulated, plan=plan), list_cells(PRESETS[plan.preset]), args.num_workers)
    if "2" in plan.tables:
        run_scenes(partial(run_real, plan=plan), plan.real, args.num_workers)
    print_tables(plan)


def run_scenes(work: Callable[[Any], None], scenes: Sequence[Any], num_workers: int) -> None:
    """Call `work`, which must not be defined in this module (a pool's processes do not import it), on every scene."""
    if scenes:
        for _ in tqdm(run_all(work, scenes, num_workers), total=len(scenes), unit="scene"):
            pass


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper_tables",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--preset", choices=list(PRESETS), default="small", help="small: 4 scenes, minutes; paper: 48")
    parser.add_argument("--cache", type=Path, default=Path("results/paper_tables"), help="for scenes and records")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES)
    parser.add_argument("--num_workers", type=int, default=1, help="scenes at once")
    parser.add_argument("--detector", help="also match the masks of this detector: a shipped one's name, or a file")
    parser.add_argument("--real", nargs="+", type=Path, default=[], help="real scene folders for table 2")
    return parser


if __name__ == "__main__":
    main()
