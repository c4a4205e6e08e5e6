"""Speed of every stage, and how it grows: `make bench`, or `python -m benchmarks.speed [--full] [--previous DIR]`

Writes performance.json and performance.png into a folder, and its two tables between their marks in the performance.md
that lies there.

Growth: simulated plants with a segmenter's faults, one axis at a time: views, leaves, megapixels. Each scene runs in a
process of its own, one thread, and with --previous the two versions of mvseg take turns. Figures are medians of CPU
seconds, which others on the machine change least; wall seconds are in the JSON. Slopes are fitted: log cost against log
(pairs of views x labelled pixels) for the affinity, against log (masks x views) for the rest; 1 = grows in proportion.

Threads: all stages of the base scene, and the commands on the shipped plant, with one and with two threads in turns.
`--threads_only` measures nothing else, and leaves the growth as it stands. `--growth_only` prints the growth alone:
`make bench PREVIOUS=DIR FULL="--growth_only --rounds 1"` says in one run how this version compares with another.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.faults import Faults, degrade_labels
from benchmarks.label_maps import visible_ids
from benchmarks.speed.write_up import growth_lines, write_all
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant

ROOT = Path(__file__).parents[2]
Cell = tuple[int, int, float]  # views, leaves, megapixels
THREADS = (1, 2)
BASE: Cell = (10, 16, 0.3)
QUICK = {"views": (5, 20, 40), "leaves": (4, 32), "megapixels": (1.2, 4.8)}
FULL = {"views": (5, 20, 40, 80), "leaves": (4, 8, 32, 64), "megapixels": (1.2, 4.8, 12.0, 24.0)}


def list_cells(axes: dict[str, tuple[float, ...]]) -> list[Cell]:
    """The base cell, and along each axis the others."""
    cells = [BASE]
    for axis, values in enumerate(axes.values()):
        cells += [tuple(value if n == axis else base for n, base in enumerate(BASE)) for value in values]  # type: ignore[misc]
    return cells


def make_scene(cell: Cell, folder: Path) -> Path:
    """Label maps and cameras of a plant; kept in `folder`."""
    views, leaves, megapixels = cell
    path = folder / f"{views}_{leaves}_{megapixels}.npz"
    if not path.exists():
        width = 4 * round((megapixels * 1e6 * 4 / 3) ** 0.5 / 4)
        plant = grow_plant("ovate", leaves, seed=3)
        cameras = arc_cameras(views, plant, width=width, height=3 * width // 4)
        true = visible_ids(plant, cameras)
        degraded = np.stack([degrade_labels(labels, Faults(), seed=view) for view, labels in enumerate(true)])
        poses = {name: getattr(cameras, name).numpy() for name in ("K", "R", "t", "sizes")}
        np.savez_compressed(path, true=true, degraded=degraded, **poses)
    return path


def make_environment(checkout: Path, threads: int) -> dict[str, str]:
    """For a process that uses the mvseg of a checkout, and so many threads, which sleep when idle (as `mvseg` does)."""
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), str(threads))
    return os.environ | limits | {"PYTHONPATH": str(checkout), "OMP_WAIT_POLICY": "passive"}


def run_cell(scene: Path, checkout: Path, *, threads: int = 1, every: bool = False) -> dict[str, Any]:
    """One run of a checkout's own stages.py: what it imports changes its name from version to version."""
    stages = checkout / "benchmarks" / "speed" / "stages.py"
    command = [sys.executable, str(stages), str(scene), "--threads", str(threads)]
    command += ["--every"] if every else []
    environment = make_environment(checkout, threads)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{scene.stem}: {done.stderr[-2000:]}")
    record: dict[str, Any] = json.loads(done.stdout)
    return record


def run_shell(verb: str, checkout: Path, *, threads: int) -> tuple[float, float]:
    """Wall and CPU seconds of `mvseg VERB` on the shipped plant; surfaces in as many processes as threads."""
    environment = make_environment(checkout, threads)
    program = "import sys; from mvseg.cli import main; sys.exit(main())"
    command = [sys.executable, "-P", "-c", program, verb, str(checkout / "mvseg" / "demo_plant"), "--quiet"]
    if verb == "infer" and (checkout / "mvseg" / "worker_pool.py").exists():  # earlier versions have one process only
        command += ["--num_workers", str(threads)]
    with tempfile.TemporaryDirectory() as out:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [*command, "--out", str(Path(out) / verb)], env=environment, capture_output=True, text=True, check=False
        )
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"mvseg {verb}: {done.stderr[-2000:]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def take_medians(runs: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """Median wall and CPU seconds of each stage over the rounds."""
    return {
        stage: np.median([run["seconds"][stage] for run in runs], 0).round(4).tolist() for stage in runs[0]["seconds"]
    }


def measure_growth(
    cells: Sequence[Cell], versions: dict[str, Path], *, rounds: int, cache: Path
) -> list[dict[str, Any]]:
    """One record per cell and version."""
    runs: dict[tuple[Cell, str], list[dict[str, Any]]] = {}
    for _ in range(rounds):
        for cell in cells:
            for name, checkout in versions.items():
                runs.setdefault((cell, name), []).append(run_cell(make_scene(cell, cache), checkout))
                print(f"{cell} {name}", file=sys.stderr)
    return [
        of_cell[0] | {"cell": cell, "version": name, "seconds": take_medians(of_cell)}
        for (cell, name), of_cell in runs.items()
    ]


def measure_threads(versions: dict[str, Path], *, rounds: int, cache: Path) -> list[dict[str, Any]]:
    """One record per version and number of threads; of the previous version one thread only."""
    kinds = [("now", threads) for threads in THREADS] + [("previous", 1)] * ("previous" in versions)
    runs: dict[tuple[str, int], list[dict[str, Any]]] = {kind: [] for kind in kinds}
    for _ in range(rounds):
        for (name, threads), so_far in runs.items():
            so_far.append(run_cell(make_scene(BASE, cache), versions[name], threads=threads, every=True))
            print(f"stages, {name}, {threads} threads", file=sys.stderr)
        for verb in ("match", "infer"):
            for (name, threads), so_far in runs.items():
                so_far[-1]["seconds"][f"mvseg {verb}"] = run_shell(verb, versions[name], threads=threads)
                print(f"mvseg {verb}, {name}, {threads} threads", file=sys.stderr)
    return [
        so_far[0] | {"cell": BASE, "version": name, "threads": threads, "seconds": take_medians(so_far)}
        for (name, threads), so_far in runs.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="5 to 80 views, 4 to 64 leaves, up to 24 megapixels")
    parser.add_argument("--previous", type=Path, help="another checkout of mvseg, which takes turns with this one")
    parser.add_argument("--threads_only", action="store_true", help="the base scene alone; the other table stays")
    parser.add_argument("--growth_only", action="store_true", help="one thread, no commands; nothing is written")
    parser.add_argument(
        "--axes", nargs="+", choices=QUICK, default=list(QUICK), help="along which the growth is measured"
    )
    parser.add_argument("--rounds", type=int, default=2, help="of all scenes; the figures are medians")
    parser.add_argument("--cache", type=Path, help="folder for the rendered scenes")
    parser.add_argument("--into", type=Path, default=Path("results/speed"), help="folder for what is written")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        cache = args.cache or Path(scratch)
        cache.mkdir(parents=True, exist_ok=True)
        versions = {"now": ROOT} | ({"previous": args.previous.resolve()} if args.previous else {})
        values = FULL if args.full else QUICK
        cells = list_cells({axis: values[axis] if axis in args.axes else () for axis in values})
        cells = [] if args.threads_only else cells
        records = measure_growth(cells, versions, rounds=args.rounds, cache=cache)
        if args.growth_only:
            print("\n".join(growth_lines(records, {})))
            return
        threads = measure_threads(versions, rounds=args.rounds, cache=cache)
    args.into.mkdir(parents=True, exist_ok=True)
    write_all(args.into, records, threads)


if __name__ == "__main__":
    main()
