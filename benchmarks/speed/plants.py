"""What a night of many plants costs: `python -m benchmarks.speed.plants --cache DIR [--plants 64] [--dask]`

Simulated plants of 8 leaves in 10 views with true masks go through `mvseg batch` on two local workers, or on a Dask
cluster of two processes; of DIFFERENT plants, each comes again under other names. Printed as JSON: plants per hour, CPU
seconds per plant (those of processes that came and went included), peak memory of the workers, the load of the machine,
and what handing out a plant costs: tasks that do nothing, on the same workers.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.speed.__main__ import ROOT, make_environment
from mvseg.batch.workers import open_workers
from mvseg.simulation.dataset import Preset, write_dataset

WORKERS, DIFFERENT, TASKS, MANY = 2, 8, 200, 1000


def do_nothing(item: int) -> int:
    """The work whose only cost is to be handed out."""
    return item


def cpu_seconds() -> float:
    """Of this process, and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


@contextmanager
def start_cluster() -> Iterator[str]:
    """A Dask cluster of WORKERS processes, one thread each: the address of its scheduler."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


def time_empty_tasks(scheduler: str | None) -> float:
    """Wall milliseconds per task that does nothing, workers running."""
    with open_workers(do_nothing, WORKERS, scheduler) as run:
        answers = run({number: number for number in range(TASKS)}, lambda _: None)
        next(answers)  # the workers are there
        start = time.perf_counter()
        assert sum(1 for _ in answers) == TASKS - 1
        return 1000 * (time.perf_counter() - start) / (TASKS - 1)


def run_plants(table: Path, scheduler: str | None) -> list[dict[str, str]]:
    """The rows of `summary.csv` of a batch over a table of scenes."""
    places = ["--num_workers", str(WORKERS)] if scheduler is None else ["--scheduler", scheduler]
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "mvseg.cli", "batch", str(table), "--masks", "truth", "--quiet", *places]
        environment = make_environment(ROOT, 1)
        done = subprocess.run(
            [*command, "--out", f"{out}/night"], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(done.stderr[-2000:])
        with Path(out, "night", "tables", "summary.csv").open(encoding="utf-8", newline="") as lines:
            return list(csv.DictReader(lines))


def write_plants(folder: Path, num_plants: int) -> Path:
    """A table of so many plants; those that differ are rendered unless they are there."""
    write_dataset(Preset(plants=(("dev", DIFFERENT),), leaves=(8,), views=(10,)), folder)
    scenes = sorted(path.name for path in (folder / "dev").iterdir())
    rows = [f"dev/{scenes[number % len(scenes)]},plant-{number:04d}" for number in range(num_plants)]
    table = folder / f"{num_plants}.csv"
    table.write_text("\n".join(("scene,name", *rows)), encoding="utf-8")
    return table


def measure(table: Path, *, has_dask: bool) -> dict[str, Any]:
    """One record for a table of scenes."""
    before, start = cpu_seconds(), time.perf_counter()
    if has_dask:
        with start_cluster() as scheduler:
            rows, wall = run_plants(table, scheduler), time.perf_counter() - start
        cpu = cpu_seconds() - before
        with start_cluster() as scheduler:
            overhead = time_empty_tasks(scheduler)
    else:
        rows, wall, cpu = run_plants(table, None), time.perf_counter() - start, cpu_seconds() - before
        overhead = time_empty_tasks(None)
    return {
        "workers": f"{WORKERS} of Dask" if has_dask else f"{WORKERS} local ones",
        "plants": len(rows),
        "load": round(os.getloadavg()[1], 1),
        "wall_s": round(wall),
        "plants_per_hour": round(3600 * len(rows) / wall),
        "cpu_s_per_plant": round(cpu / len(rows), 2),
        "plants_per_hour_idle_machine": round(3600 * WORKERS * len(rows) / cpu),
        f"cpu_hours_of_{MANY}": round(cpu / len(rows) * MANY / 3600, 2),
        "peak_mb_per_worker": max(float(row["peak_mb"]) for row in rows),
        "ms_per_empty_task": round(overhead, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="the plants are rendered into this folder once")
    parser.add_argument("--plants", type=int, default=64)
    parser.add_argument("--dask", action="store_true")
    args = parser.parse_args()
    os.environ.update(make_environment(ROOT, 1))
    print(json.dumps(measure(write_plants(args.cache / "plants", args.plants), has_dask=args.dask), indent=1))


if __name__ == "__main__":
    main()
