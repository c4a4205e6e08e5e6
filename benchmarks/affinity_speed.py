"""Affinity by plane angles against affinity by drawn lines: `python benchmarks/affinity_speed.py`

A simulated plant of 16 leaves in 10 views of 640 x 480. The drawn twin (tests/reference.py: the epipolar lines of 200
points per region, drawn two pixels wide and counted against the mask of every region) is timed on a few regions and
scaled up to all. `--agreement` compares the results instead, on the shipped scene and over four samplings: that takes a
quarter of an hour.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.demo import demo_scene
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.affinity import region_affinity
from mvseg.regions import regions_from_label_maps
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.ray_cast import build_stage, render_stage
from mvseg.simulation.scene_writer import drop_small
from reference import affinity_reference


def measure_speed(num_senders: int) -> dict[str, float]:
    """Median time of five runs by plane angles, and that of drawn lines from the first view to the last."""
    plant = grow_plant("ovate", 16, seed=1)
    cameras = arc_cameras(10, plant, width=640, height=480)
    stage = build_stage(plant, seed=1)
    maps = [drop_small(render_stage(stage, cameras, view).ids, 30) for view in range(len(cameras))]
    regions = regions_from_label_maps(maps)
    region_affinity(regions, cameras)  # warms up
    runs = []
    for _ in range(5):
        start = time.perf_counter()
        region_affinity(regions, cameras)
        runs.append(time.perf_counter() - start)
    senders = torch.linspace(0, len(regions) - 1, num_senders).long().tolist()
    start = time.perf_counter()
    affinity_reference(regions, cameras, senders=senders)
    drawn = (time.perf_counter() - start) * len(regions) / num_senders
    angles = sorted(runs)[len(runs) // 2]
    return {"regions": len(regions), "angles_s": angles, "drawn_s": drawn, "ratio": drawn / angles}


def measure_agreement() -> dict[str, float]:
    """Differences of the affinities of all pairs of regions of different views."""
    scene = load_scene(demo_scene())
    regions = load_masks(scene, demo_scene() / "masks")
    drawn = torch.stack([affinity_reference(regions, scene.cameras, 200, seed) for seed in range(4)])
    drawn = (drawn + drawn.mT) / 2
    pairs = regions.view_index[:, None] != regions.view_index
    ours = (region_affinity(regions, scene.cameras).to_dense() - drawn.mean(0))[pairs].abs()
    between = torch.stack([(drawn[a] - drawn[b])[pairs].abs() for a in range(4) for b in range(a)])
    return {
        "mean": float(ours.mean()),
        "max": float(ours.max()),
        "mean_between_samplings": float(between.mean()),
        "max_between_samplings": float(between.max()),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--senders", type=int, default=6, help="regions that the drawn twin is timed on")
    parser.add_argument("--agreement", action="store_true", help="compare the results, not the speed")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(json.dumps(measure_agreement() if args.agreement else measure_speed(args.senders), indent=1))
