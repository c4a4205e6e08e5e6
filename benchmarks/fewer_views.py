"""What fewer views give: `python -m benchmarks.fewer_views --cache DIR [--views 45 30 20 15 10] [--plants 0 1 2 3]`

Simulated plants, each in 45 photos of 800 x 600 from a walk all round it at changing heights, go through `mvseg infer
--views N`. Per plant and N: CPU seconds of the command; MV-PQ and leaves missed in its own views; MV-PQ of the run with
all views in the same views; and of the leaves with a surface, how many there are, and the median and the 90 % quantile
of the error of their areas.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.regions import Regions
from mvseg.results.read import read_instances
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene

ROOT = Path(__file__).parents[1]
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1", "PYTHONPATH": str(ROOT)}
NUM_VIEWS, SIZE, ELEVATIONS = 45, (800, 600), (20.0, 35.0, 50.0)
PLANTS = (("ovate", 12), ("rosette", 16), ("lanceolate", 8), ("ovate", 24))
FIRST_SEED = 101  # of plants that are in no other set


def write_plant(number: int, cache: Path) -> Path:
    """The scene folder of a plant; rendered unless it is in the cache."""
    family, num_leaves = PLANTS[number]
    seed = FIRST_SEED + number
    folder = cache / "plants" / f"{family}-{num_leaves:02d}_{seed}"
    if not folder.exists():
        plant = grow_plant(family, num_leaves, seed)
        width, height = SIZE
        cameras = arc_cameras(NUM_VIEWS, plant, span_deg=360, elevations_deg=ELEVATIONS, width=width, height=height)
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_scene(folder, plant, cameras, seed=seed)
    return folder


def infer(scene: Path, out: Path, views: int) -> float:
    """Run `mvseg infer`; returns its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "mvseg.cli", "infer", str(scene), "--views", str(views), "--out", str(out)]
    command += ["--num_workers", "1", "--quiet"]
    subprocess.run(command, env=os.environ | ONE_THREAD, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def view_names(out: Path) -> list[str]:
    names: list[str] = json.loads((out / "run.json").read_text())["views"]["taken"]
    return names


def area_errors(out: Path, scene: Path, regions: Regions, truth: list[np.ndarray]) -> np.ndarray:
    """Relative error of the area of every leaf with a surface, by the true leaf that most of its masks show."""
    with (scene / "truth" / "traits.csv").open(encoding="utf-8", newline="") as lines:
        true = {int(row["leaf_id"]): float(row["area"]) for row in csv.DictReader(lines)}
    shown = shown_instances(regions, truth)
    errors = []
    with (out / "traits_wide.csv").open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            leaves = shown[(regions.labels == int(row["leaf"])) & (shown > 0) & (shown < 65535)]
            if row["area"] and row["method"] == "surface" and len(leaves):
                errors.append(float(row["area"]) / true[int(leaves.mode().values)] - 1)
    return np.abs(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--views", type=int, nargs="+", default=(45, 30, 20, 15, 10))
    parser.add_argument("--plants", type=int, nargs="+", default=range(len(PLANTS)), help="which of the list, from 0")
    args = parser.parse_args()
    for number in args.plants:
        scene = write_plant(number, args.cache)
        whole: tuple[list[str], Regions, list[np.ndarray]] | None = None
        for most in args.views:
            out = args.cache / "results" / f"{scene.name}_{most:02d}"
            seconds = infer(scene, out, most)
            names, (regions, truth) = view_names(out), read_instances(out, scene / "truth")
            whole = (names, regions, truth) if whole is None else whole
            own = leaf_metrics(regions, regions.labels, truth)
            places = [whole[0].index(name) for name in names]
            same = whole[1].of_views(torch.tensor(places))
            all_views = leaf_metrics(same, same.labels, [whole[2][place] for place in places])
            errors = area_errors(out, scene, regions, truth)
            print(
                f"{scene.name:18} {len(names):3} views {seconds:6.1f} CPU s  MV-PQ {own.mv_pq:.3f} "
                f"({all_views.mv_pq:.3f} with the first)  missed {own.num_missed:2}, false {own.num_false:2}  "
                f"{len(errors):2} areas, off by {np.median(errors):.3f}, {np.quantile(errors, 0.9):.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
