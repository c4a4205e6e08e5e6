"""The stages of one scene, timed in a process of its own: `python benchmarks/speed/stages.py SCENE.npz`

Runs whatever `mvseg` PYTHONPATH leads to, an earlier one too, so it uses nothing but long-standing names. Prints JSON:
{stage: [wall, CPU seconds]}, the counts that the cost grows with, the peak memory, and a hash of the ids.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import time
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch

from mvseg.matching.affinity import region_affinity
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.multiview.loop import match_proposals
from mvseg.multiview.proposals import gather_proposals
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.shapes import reconstruct_shapes
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.results.overlay import draw_contact_sheet, draw_overlay, draw_tile
from mvseg.scene import Cameras

Value = TypeVar("Value")


class Stopwatch:
    """Wall and CPU seconds of named stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}

    def time(self, stage: str, work: Callable[[], Value]) -> Value:
        wall, cpu = time.perf_counter(), time.process_time()
        result = work()
        self.seconds[stage] = time.perf_counter() - wall, time.process_time() - cpu
        return result


def draw_pictures(regions: Regions, matching: Matching, cameras: Cameras) -> None:
    tiles, names = [], [str(view) for view in range(len(cameras))]
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        photo = np.full((height, width, 3), 40, np.uint8)
        draw_overlay(photo, regions, matching, view=view)
        tiles.append(draw_tile(photo, regions, matching, view=view))
    draw_contact_sheet(tiles, names)


def propose(maps: np.ndarray, count: int, seed: int) -> list[dict[str, torch.Tensor]]:
    """Per view, `count` jittered boxes around its masks, with elliptic masks, as a mask head returns them."""
    generator, outputs = torch.Generator().manual_seed(seed), []
    grid = torch.linspace(-1, 1, 28)
    ellipse = ((grid[:, None] ** 2 + grid**2) < 1).float()
    for labels in maps:
        boxes = regions_from_label_maps([labels]).boxes.float()
        chosen = boxes[torch.arange(count) % len(boxes)]
        sides = (chosen[:, 2:] - chosen[:, :2]).repeat(1, 2)
        chosen = chosen + 0.15 * sides * torch.randn(count, 4, generator=generator)
        chosen = torch.cat((torch.minimum(chosen[:, :2], chosen[:, 2:] - 4), chosen[:, 2:]), 1)
        height, width = labels.shape
        outputs.append(
            {
                "boxes": chosen.clamp(min=torch.zeros(4), max=torch.tensor([width, height, width, height]).float()),
                "masks": ellipse.expand(count, 1, 28, 28),
                "scores": torch.rand(count, generator=generator),
                "labels": torch.ones(count, dtype=torch.int64),
                "frame": torch.tensor([width, height]),
            }
        )
    return outputs


def run_stages(path: str, masks: str, *, proposals: int, shapes: bool) -> dict[str, Any]:
    with np.load(path) as saved:
        cameras = Cameras(**{name: torch.from_numpy(saved[name]) for name in ("K", "R", "t", "sizes")})
        maps = saved[masks]
    region_affinity(regions_from_label_maps(list(maps[:2])), cameras[[0, 1]])  # warms up
    watch = Stopwatch()
    regions = watch.time("load", lambda: regions_from_label_maps(list(maps)))
    watch.time("bytes", lambda: int(regions.crops.numpy().view(np.uint8).sum(dtype=np.int64)))
    watch.time("affinity", lambda: region_affinity(regions, cameras))
    matching = watch.time("matching", lambda: match_regions(regions, cameras))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    watch.time("pictures", lambda: draw_pictures(regions, matching, cameras))
    if shapes:
        config = ReconstructConfig()
        watch.time("shapes", lambda: reconstruct_shapes(regions, matching.instance_ids, cameras, config=config))
    if proposals:
        outputs = propose(maps, proposals, seed=0)
        found = watch.time("gather", lambda: gather_proposals(outputs, cameras.sizes.tolist()))
        watch.time("loop", lambda: match_proposals(found, cameras))
    ids = matching.instance_ids.numpy().astype(np.int64)
    return {
        "seconds": watch.seconds,
        "masks": len(regions),
        "views": len(cameras),
        "labelled_px": int(regions.areas.sum()),
        "matching_GB": peak / 2**20,
        "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "ids": hashlib.sha256(ids.tobytes()).hexdigest()[:16],
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--masks", choices=("true", "degraded"), default="degraded")
    parser.add_argument("--proposals", type=int, default=0, help="of each view, for the loop; 0: no loop")
    parser.add_argument("--shapes", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    print(json.dumps(run_stages(args.scene, args.masks, proposals=args.proposals, shapes=args.shapes)))
