"""Memory and time of the NMS loop on 28 views x 300 proposals, 1280 x 960: `python benchmarks/proposal_memory.py`

Masks as the mask head returns them (28 x 28 probabilities and boxes) are pasted as crops, matched, assigned to clusters
and suppressed.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.detection.loop import match_proposals
from mvseg.detection.proposals import gather_proposals
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import Plant, grow_plant


def mask_head_output(
    plant: Plant, cameras: Cameras, view: int, *, count: int, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """`count` jittered boxes around the projections of the leaves, with elliptic masks."""
    width, height = cameras.sizes[view].tolist()
    boxes = []
    for leaf in plant.leaves:
        px = cameras[view : view + 1].project(torch.from_numpy(leaf.vertices))[0][0]
        boxes.append(torch.cat((px.amin(0), px.amax(0))))
    chosen = torch.stack(boxes)[torch.arange(count) % len(boxes)].float()
    sides = (chosen[:, 2:] - chosen[:, :2]).repeat(1, 2)
    chosen = chosen + 0.15 * sides * torch.randn(count, 4, generator=generator)
    chosen = torch.cat((torch.minimum(chosen[:, :2], chosen[:, 2:] - 4), chosen[:, 2:]), 1)
    chosen = chosen.clamp(min=torch.zeros(4), max=torch.tensor([width, height, width, height]).float())
    grid = torch.linspace(-1, 1, 28)
    ellipse = ((grid[:, None] ** 2 + grid**2) < 1).float().expand(count, 1, 28, 28)
    return {
        "boxes": chosen,
        "masks": ellipse,
        "scores": torch.rand(count, generator=generator),
        "labels": torch.ones(count, dtype=torch.int64),
        "frame": torch.tensor([width, height]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=28)
    parser.add_argument("--proposals", type=int, default=300)
    args = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    plant = grow_plant("ovate", 28, seed=3)
    cameras = arc_cameras(args.views, plant, width=1280, height=960)
    outputs = [
        mask_head_output(plant, cameras, view, count=args.proposals, generator=generator) for view in range(args.views)
    ]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start, start_cpu = time.perf_counter(), time.process_time()
    proposals, boxes = gather_proposals(outputs, cameras.sizes.tolist())
    gathered, gathered_cpu = time.perf_counter(), time.process_time()
    matching = match_proposals(proposals, cameras, boxes=boxes)
    report = {
        "proposals": len(proposals),
        "mean_crop_px": int(proposals.regions.crop_sizes.prod(1).float().mean()),
        "kept": len(matching),
        "instances": matching.num_instances,
        "gather_s": round(gathered - start, 1),
        "gather_cpu_s": round(gathered_cpu - start_cpu, 1),
        "loop_s": round(time.perf_counter() - gathered, 1),
        "loop_cpu_s": round(time.process_time() - gathered_cpu, 1),
        "peak_memory_GB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "memory_before_GB": round(before / 2**20, 2),
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
