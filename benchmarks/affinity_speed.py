"""Affinity by plane angles against affinity by drawn lines, side by side: `python benchmarks/affinity_speed.py`

A simulated plant of 16 leaves in 10 views of 640 x 480. The drawn twin (tests/reference.py: 200 points per region,
OpenCV lines of two pixels, each counted against every region's mask) is timed on some regions and scaled to all.
`--agreement` instead compares both on the whole shipped scene, over four samplings; that takes a quarter of an hour.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import torch

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from mvseg.demo import demo_scene  # noqa: E402
from mvseg.formats.scene_folder import load_masks, load_scene  # noqa: E402
from mvseg.matching.affinity import region_affinity  # noqa: E402
from mvseg.regions import regions_from_label_maps  # noqa: E402
from mvseg.simulation.cameras import arc_cameras  # noqa: E402
from mvseg.simulation.dataset import drop_small  # noqa: E402
from mvseg.simulation.growth import grow_plant  # noqa: E402
from mvseg.simulation.ray_cast import build_stage, render_stage  # noqa: E402
from reference import affinity_reference  # noqa: E402


def measure_speed(num_senders: int) -> dict[str, float]:
    plant = grow_plant("ovate", 16, seed=1)
    cameras = arc_cameras(10, plant, width=640, height=480)
    stage = build_stage(plant, seed=1)
    poses = zip(cameras.K.numpy(), cameras.R.numpy(), cameras.t.numpy(), strict=True)
    regions = regions_from_label_maps([drop_small(render_stage(stage, K, R, t, 640, 480).ids, 30) for K, R, t in poses])
    region_affinity(regions, cameras)
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--senders", type=int, default=6, help="regions that the drawn twin is timed on")
    parser.add_argument("--agreement", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(json.dumps(measure_agreement() if args.agreement else measure_speed(args.senders), indent=1))
