"""From photos to leaves, as docs/guide.md begins: `python -m benchmarks.phone_walk --out DIR`

The shipped plant is photographed on a walk once round it: 20 photos of 1632 x 1224 pixels, the camera going up and
down. Then `mvseg pose` and `mvseg infer` run on the photos alone; `mvseg check` and `mvseg match` on these cameras with
the masks that were found. Printed: CPU seconds of each, and how many photos and leaves there are. For the time of an
edit of the result, see `speed/edits.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.demo_plant import NUM_LEAVES, SEED
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene

ROOT = Path(__file__).parents[1]
NUM_PHOTOS, SIZE = 20, (1632, 1224)


def write_walk(folder: Path) -> None:
    """The photos, with cameras and truth that the commands do not see."""
    plant = grow_plant("ovate", NUM_LEAVES, seed=SEED)
    heights = 35 + 12 * np.sin(np.linspace(0, 4 * np.pi, NUM_PHOTOS, endpoint=False))
    width, height = SIZE
    elevations = tuple(heights.tolist())
    cameras = arc_cameras(NUM_PHOTOS, plant, span_deg=360, elevations_deg=elevations, width=width, height=height)
    write_scene(folder, plant, cameras, seed=SEED)


def run(*words: str) -> float:
    """Run a verb on one thread; returns its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "mvseg.cli", *words, "--quiet"]
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="for photos, cameras and result; photos are kept")
    out = parser.parse_args().out
    if not (out / "walk").exists():
        out.mkdir(parents=True, exist_ok=True)
        write_walk(out / "walk")
    plant, result = str(out / "plant"), str(out / "result")
    posing = run("pose", str(out / "walk" / "images"), "--out", plant)
    registered = len(json.loads((out / "plant" / "pose.json").read_text())["registered"])
    print(f"pose {posing:.0f} CPU s: {registered} of {NUM_PHOTOS} photos registered", flush=True)
    inferring = run("infer", plant, "--num_workers", "1", "--out", result)
    leaves = json.loads((out / "result" / "run.json").read_text())["counts"]["instances"]
    print(f"infer {inferring:.0f} CPU s: {leaves} leaves found, {NUM_LEAVES} are there", flush=True)
    masks = "--masks", f"{result}/labels"
    print(f"check {run('check', plant, *masks):.0f} CPU s", flush=True)
    print(f"match {run('match', plant, *masks, '--out', str(out / 'matched')):.0f} CPU s")


if __name__ == "__main__":
    main()
