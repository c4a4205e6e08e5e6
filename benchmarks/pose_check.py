"""What `mvseg check` says about poses: false alarms on sound scenes, and which faults it names.

    python benchmarks/pose_check.py --cache DIR --split dev --seed 3 --plants 2

Faults are of one view (turned about an axis of its own by 1, 3 or 10 degrees, or moved 25 degrees round the plant), of
two (swapped), or of all (cameras of the previous photo). The thresholds in mvseg/checks/poses.py were chosen with
seed 0.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps
from mvseg.checks.poses import pairwise_agreement, pose_findings
from mvseg.regions import Regions
from mvseg.scene import Cameras

AXIS = np.array([0.13, -0.13, 0.64])  # as good as any
FAULTS = ("none", "turned 1", "turned 3", "turned 10", "moved 25", "two swapped", "all of the previous photo")


def rotation(axis: np.ndarray, degrees: float) -> Tensor:
    return torch.from_numpy(cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0])


def put_fault(cameras: Cameras, fault: str) -> tuple[Cameras, set[int]]:
    """The cameras with a fault, and the views that have it; none where all have."""
    num, R, t = len(cameras), cameras.R.clone(), cameras.t.clone()
    kind, _, degrees = fault.partition(" ")
    if kind == "turned":
        turn = rotation(AXIS, float(degrees))
        R[1], t[1] = turn @ R[1], turn @ t[1]
        return replace(cameras, R=R, t=t), {1}
    if kind == "moved":  # round the vertical through the world's origin, where the plant stands
        R[1] = R[1] @ rotation(np.array([0.0, 0.0, 1.0]), float(degrees))
        return replace(cameras, R=R), {1}
    if kind == "two":
        return cameras[[1, 0, *range(2, num)]], {0, 1}
    return (cameras, set()) if fault == "none" else (cameras[[num - 1, *range(num - 1)]], set())


def judge(regions: Regions, cameras: Cameras, faulty: set[int]) -> str:
    """What the findings say of a fault: the right views, these among others, the whole scene, or nothing."""
    found = pose_findings(pairwise_agreement(regions, cameras), tuple(map(str, range(len(cameras)))))
    level = "error" if any(each.level == "error" for each in found) else "warning"
    if not found:
        return "nothing"
    if any(not each.views for each in found):
        return f"{level}: whole scene"
    named = {view for each in found for view in each.views}
    right = "exactly" if named == faulty else "some right" if named & faulty else "wrong"
    return f"{level}: views ({right})" if faulty else f"{level}: views"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    args = parser.parse_args()
    said: dict[tuple[str, str, str], Counter[str]] = defaultdict(Counter)
    for spec in chosen_scenes(args):
        scene = load_maps(spec, args.cache)
        views = "3 views" if spec.num_views == 3 else "5 to 20 views"
        for kind in KINDS:
            regions, _ = scene.masks(kind)
            for fault in FAULTS:
                cameras, faulty = put_fault(scene.cameras, fault)
                said[views, kind, fault][judge(regions, cameras, faulty)] += 1
    for (views, kind, fault), counts in sorted(said.items(), key=lambda item: (item[0][:2], FAULTS.index(item[0][2]))):
        print(f"{views:14} {kind:9} {fault:26}", ", ".join(f"{count} {what}" for what, count in counts.most_common()))


if __name__ == "__main__":
    main()
