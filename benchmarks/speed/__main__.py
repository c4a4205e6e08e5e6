"""Speed of every stage, and how it grows: `make bench`, or `python -m benchmarks.speed [--full] [--previous DIR]`

Writes performance.json and performance.png into a folder, and its tables between two marks of the performance.md that
lies there.

Simulated plants with a segmenter's faults, one axis at a time: views, leaves, megapixels. Each scene runs in a process
of its own, one thread, and with --previous the two versions of mvseg take turns. Figures are medians of CPU seconds,
which others on the machine change least; wall seconds are in the JSON. Slopes are fitted: log cost against log (pairs
of views x labelled pixels) for the affinity, against log (masks x views) for the rest; 1 = grows in proportion.
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
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.label_maps import visible_ids
from benchmarks.speed.rivals import measure_rivals
from benchmarks.speed.write_up import draw_plot, fit_slopes, table_lines, write_between
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.faults import Faults, degrade_labels
from mvseg.simulation.growth import grow_plant

ROOT = Path(__file__).parents[2]
Cell = tuple[int, int, float]  # views, leaves, megapixels
PROPOSALS = 100  # of each view, for the loop in the base scene
STAGES = ("load", "bytes", "affinity", "matching", "gather", "loop", "shapes", "pictures")
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


def run_cell(scene: Path, checkout: Path, options: list[str]) -> dict[str, Any]:
    """One run of stages.py with the mvseg of a checkout."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).with_name("stages.py")), str(scene), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{scene.stem}: {done.stderr[-2000:]}")
    record: dict[str, Any] = json.loads(done.stdout)
    return record


def run_shell(verb: str, checkout: Path) -> tuple[float, float]:
    """Wall and CPU seconds of `mvseg VERB` on the shipped plant."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    program = "import sys; from mvseg.cli import main; sys.exit(main())"
    command = [sys.executable, "-P", "-c", program, verb, str(checkout / "mvseg" / "demo_plant"), "--quiet"]
    with tempfile.TemporaryDirectory() as out:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [*command, "--out", str(Path(out) / verb)], env=environment, capture_output=True, text=True, check=False
        )
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"mvseg {verb}: {done.stderr[-2000:]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(args: argparse.Namespace, cache: Path) -> list[dict[str, Any]]:
    """One record per cell and version: medians over the rounds."""
    versions = {"now": ROOT} | ({"previous": args.previous.resolve()} if args.previous else {})
    runs: dict[tuple[Cell, str], list[dict[str, Any]]] = {}
    cells = list_cells(FULL if args.full else QUICK)
    for _ in range(args.rounds):
        for cell in cells:
            options = ["--shapes", "--proposals", str(PROPOSALS)] if cell == BASE else []
            for name, checkout in versions.items():
                runs.setdefault((cell, name), []).append(run_cell(make_scene(cell, cache), checkout, options))
                print(f"{cell} {name}", file=sys.stderr)
    records = []
    for (cell, name), of_cell in runs.items():
        seconds = {
            stage: np.median([run["seconds"][stage] for run in of_cell], 0).round(4).tolist()
            for stage in STAGES
            if stage in of_cell[0]["seconds"]
        }
        records.append(of_cell[0] | {"cell": cell, "version": name, "seconds": seconds})
    base_runs = [record for record in records if tuple(record["cell"]) == BASE]
    shell: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(args.rounds):
        for verb in ("match", "infer"):
            for name, checkout in versions.items():
                shell.setdefault((name, verb), []).append(run_shell(verb, checkout))
                print(f"mvseg {verb} {name}", file=sys.stderr)
    for record in base_runs:
        for verb in ("match", "infer"):
            record["seconds"][f"mvseg {verb}"] = np.median(shell[record["version"], verb], 0).round(3).tolist()
    return records


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="5 to 80 views, 4 to 64 leaves, up to 24 megapixels")
    parser.add_argument("--previous", type=Path, help="another checkout of mvseg, which takes turns with this one")
    parser.add_argument("--rounds", type=int, default=2, help="of all scenes; the figures are medians")
    parser.add_argument("--cache", type=Path, help="folder for the rendered scenes")
    parser.add_argument("--into", type=Path, default=Path("results/speed"), help="folder for what is written")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        cache = args.cache or Path(scratch)
        cache.mkdir(parents=True, exist_ok=True)
        records = measure(args, cache)
        with np.load(make_scene(BASE, cache)) as saved:
            cameras = Cameras(**{name: torch.from_numpy(saved[name]) for name in ("K", "R", "t", "sizes")})
            rivals = measure_rivals(regions_from_label_maps(list(saved["true"])), cameras)
    versions = {record["version"] for record in records}
    slopes = {name: fit_slopes([record for record in records if record["version"] == name]) for name in versions}
    args.into.mkdir(parents=True, exist_ok=True)
    report = json.dumps({"cells": records, "rivals": rivals, "slopes": slopes}, indent=1)
    (args.into / "performance.json").write_text(report + "\n", encoding="utf-8")
    lines = table_lines(records, rivals, slopes)
    print("\n".join(lines))
    draw_plot(records, args.into / "performance.png")
    page = args.into / "performance.md"
    if page.is_file():
        page.write_text(write_between(page.read_text(encoding="utf-8"), lines), encoding="utf-8")


if __name__ == "__main__":
    main()
