"""Speed of every stage, and how it grows: `make bench`, or `python -m benchmarks.speed [--full] [--previous DIR]`

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
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.faults import Faults, degrade_labels
from mvseg.simulation.growth import grow_plant

ROOT = Path(__file__).parents[2]
Cell = tuple[int, int, float]  # views, leaves, megapixels
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


def run_shell(verb: str, checkout: Path, out: Path) -> tuple[float, float]:
    """Wall and CPU seconds of `mvseg VERB` on the shipped plant."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    program = "import sys; from mvseg.cli import main; sys.exit(main())"
    command = [sys.executable, "-P", "-c", program, verb, str(checkout / "mvseg" / "demo_plant"), "--quiet"]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([*command, "--out", str(out / verb)], env=environment, capture_output=True, check=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(args: argparse.Namespace, cache: Path) -> list[dict[str, Any]]:
    """One record per cell and version: medians over the rounds."""
    versions = {"now": ROOT} | ({"previous": args.previous.resolve()} if args.previous else {})
    runs: dict[tuple[Cell, str], list[dict[str, Any]]] = {}
    cells = list_cells(FULL if args.full else QUICK)
    for _ in range(args.rounds):
        for cell in cells:
            options = ["--shapes", "--proposals", "100"] if cell == BASE else []
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
                shell.setdefault((name, verb), []).append(run_shell(verb, checkout, cache))
    for record in base_runs:
        for verb in ("match", "infer"):
            record["seconds"][f"mvseg {verb}"] = np.median(shell[record["version"], verb], 0).round(3).tolist()
    return records


def fit_slopes(records: list[dict[str, Any]]) -> dict[str, float]:
    """Exponent of the cost of each stage over all cells."""
    slopes = {}
    for stage in ("affinity", "matching", "pictures"):
        cost = [record["seconds"][stage][1] for record in records]
        pairs = [record["views"] * (record["views"] - 1) / 2 * record["labelled_px"] for record in records]
        size = pairs if stage == "affinity" else [record["masks"] * record["views"] for record in records]
        slopes[stage] = round(float(np.polyfit(np.log(size), np.log(cost), 1)[0]), 2)
    return slopes


def print_table(records: list[dict[str, Any]], rivals: dict[str, float]) -> None:
    """Markdown: one row per cell, CPU seconds; "a / b" is now / previous."""
    cells = list(dict.fromkeys(tuple(record["cell"]) for record in records))
    of = {(tuple(record["cell"]), record["version"]): record for record in records}
    shown = ("load", "affinity", "matching", "pictures")
    print("| views | leaves | Mpx | masks | " + " | ".join(shown) + " | GB | ids |")
    print("|---" * (6 + len(shown)) + "|")
    for cell in cells:
        now, previous = of[cell, "now"], of.get((cell, "previous"))
        figures = []
        for stage in shown:
            both = [record["seconds"][stage][1] for record in (now, previous) if record]
            figures.append(" / ".join(f"{seconds:.3f}" for seconds in both))
        memory = " / ".join(f"{record['matching_GB']:.2f}" for record in (now, previous) if record)
        ids = "" if previous is None else "same" if now["ids"] == previous["ids"] else "differ"
        print(f"| {cell[0]} | {cell[1]} | {cell[2]} | {now['masks']} | {' | '.join(figures)} | {memory} | {ids} |")
    base = [of[BASE, name] for name in ("now", "previous") if (BASE, name) in of]
    print("\n| base scene | CPU s | wall s |\n|---|---|---|")
    for stage in base[0]["seconds"]:
        wall, cpu = (" / ".join(f"{record['seconds'][stage][n]:.3f}" for record in base) for n in (0, 1))
        print(f"| {stage} | {cpu} | {wall} |")
    for name, seconds in rivals.items():
        print(f"| {name} | {seconds:.3f} | |")


def draw_plot(records: list[dict[str, Any]], path: Path) -> None:
    """CPU seconds along each axis, on logarithmic scales; the version before is dashed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), sharey=True)
    for axis, (panel, title) in enumerate(zip(axes, ("views", "leaves", "megapixels"), strict=True)):
        others = [n for n in range(3) if n != axis]
        for version, style in (("now", "-"), ("previous", "--")):
            on_axis = [
                record
                for record in records
                if record["version"] == version and all(record["cell"][n] == BASE[n] for n in others)
            ]
            on_axis.sort(key=lambda record: record["cell"][axis])
            for color, stage in enumerate(("load", "affinity", "matching", "pictures")):
                x = [record["cell"][axis] for record in on_axis]
                y = [record["seconds"][stage][1] for record in on_axis]
                label = stage if version == "now" else None
                panel.plot(x, y, style, color=f"C{color}", marker="o", markersize=3, label=label)
        panel.set(xscale="log", yscale="log", xlabel=title)
        ticks = sorted({record["cell"][axis] for record in records})
        panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("CPU seconds, one thread")
    axes[2].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="5 to 80 views, 4 to 64 leaves, up to 24 megapixels")
    parser.add_argument("--previous", type=Path, help="another checkout of mvseg, which takes turns with this one")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cache", type=Path, help="folder for the rendered scenes")
    parser.add_argument("--json", type=Path, default=Path("speed.json"))
    parser.add_argument("--plot", type=Path, default=Path("speed.png"))
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
    args.json.write_text(json.dumps({"cells": records, "rivals": rivals, "slopes": slopes}, indent=1), encoding="utf-8")
    print_table(records, rivals)
    print("\nslopes:", json.dumps(slopes))
    draw_plot(records, args.plot)


if __name__ == "__main__":
    main()
