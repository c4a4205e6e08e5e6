"""The stages of one scene, timed in a process of its own: `python benchmarks/speed/stages.py SCENE.npz`

Runs the `mvseg` that PYTHONPATH leads to; each version of this file goes with the mvseg beside it.
Prints JSON: {stage: [wall, CPU seconds]}, the counts that the cost grows with, the peak memory, and a hash of the ids.
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

import cv2
import numpy as np
import torch
from torch import Tensor

from mvseg.demo import demo_scene
from mvseg.detection.loop import match_proposals
from mvseg.detection.proposals import gather_proposals
from mvseg.detectors.run import run_heads
from mvseg.detectors.zoo import load_detector
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.matching.affinity import region_affinity
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.results.overlay import draw_overlay
from mvseg.scene import Cameras
from mvseg.system.running import running

Value = TypeVar("Value")
PROPOSALS = 100  # of each view, for the loop
DETECTOR, PHOTO_SIDE = "leaf-lite", 800


class Stopwatch:
    """Wall and CPU seconds of named stages, those of processes that came and went included."""

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}

    def time(self, stage: str, work: Callable[[], Value]) -> Value:
        wall, cpu = time.perf_counter(), cpu_seconds()
        result = work()
        self.seconds[stage] = time.perf_counter() - wall, cpu_seconds() - cpu
        return result


def cpu_seconds() -> float:
    gone = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + gone.ru_utime + gone.ru_stime


def draw_pictures(masks: Masks, cameras: Cameras) -> None:
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        photo = np.full((height, width, 3), 40, np.uint8)
        draw_overlay(photo, masks, view=view)


def fit_shapes(regions: Regions, instance_ids: Tensor, cameras: Cameras, *, num_workers: int) -> None:
    with running(num_workers=num_workers):
        fit_surfaces(regions, instance_ids, cameras)


def propose(maps: np.ndarray, count: int, seed: int) -> list[dict[str, Tensor]]:
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


def time_all(watch: Stopwatch, regions: Regions, matching: Matching, cameras: Cameras, maps: np.ndarray) -> None:
    """The stages that take seconds, and the shipped detector on one photo of the shipped plant."""
    threads = torch.get_num_threads()
    watch.time("shapes", lambda: fit_shapes(regions, matching.instance_ids, cameras, num_workers=threads))
    outputs = propose(maps, PROPOSALS, seed=0)
    found, boxes = watch.time("gather", lambda: gather_proposals(outputs, cameras.sizes.tolist()))
    watch.time("loop", lambda: match_proposals(found, cameras, boxes=boxes))
    detector, photo = load_detector(DETECTOR, image_size=PHOTO_SIDE), load_photos(load_scene(demo_scene()))[0]
    with torch.no_grad():
        run_heads(detector, photo)  # warms up
        watch.time("detector", lambda: run_heads(detector, photo))


def run_stages(path: str, masks: str, *, every: bool) -> dict[str, Any]:
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
    watch.time("pictures", lambda: draw_pictures(matching.masks, cameras))
    if every:
        time_all(watch, regions, matching, cameras, maps)
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
    parser.add_argument("--every", action="store_true", help="shapes, gather, loop and the detector, too")
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV, and processes for the shapes")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    warnings.simplefilter("ignore")
    print(json.dumps(run_stages(args.scene, args.masks, every=args.every)))
