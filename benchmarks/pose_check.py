"""What `mvseg check` says about poses: false alarms on sound scenes, and which faults it names.

    python benchmarks/pose_check.py --cache DIR --split dev --seed 3 --plants 2
    python benchmarks/pose_check.py --cache DIR --split dev --seed 3 --plants 1 --photos

Faults are of one view (turned about an axis of its own by 1, 3 or 10 degrees, or moved 25 degrees round the plant), of
two (swapped), of half of the views (every second t longer, or the first half turned by 10 degrees round the vertical),
or of all (cameras of the previous photo; other focal lengths). With --photos, features of the photos are asked instead
of the masks. The thresholds in mvseg/checks/poses.py were chosen with
seed 0.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps, load_photos
from mvseg.checks.epipolar_distances import distance_findings, scale_focal
from mvseg.checks.finding import Finding
from mvseg.checks.groups import group_findings
from mvseg.checks.photo_matches import match_photos
from mvseg.checks.poses import pairwise_agreement, pose_findings
from mvseg.regions import Regions
from mvseg.scene import Cameras

AXIS = np.array([0.13, -0.13, 0.64])  # as good as any
HALVES = ("farther 1.2", "farther 1.1", "half 10")
FAULTS = ("none", "turned 1", "turned 3", "turned 10", "moved 25", "two swapped", *HALVES, "all of the previous photo")
BY_PHOTOS = ("none", "turned 10", *HALVES, "focal 1.1", "focal 0.5")


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
    if kind == "half":
        R[: num // 2] = R[: num // 2] @ rotation(np.array([0.0, 0.0, 1.0]), float(degrees))
        return replace(cameras, R=R), set(range(num // 2))
    if kind == "farther":
        t[::2] *= float(degrees)
        return replace(cameras, t=t), set(range(1, num, 2))
    if kind == "focal":
        return scale_focal(cameras, float(degrees)), set()
    if kind == "two":
        return cameras[[1, 0, *range(2, num)]], {0, 1}
    return (cameras, set()) if fault == "none" else (cameras[[num - 1, *range(num - 1)]], set())


def ask_masks(regions: Regions, cameras: Cameras) -> list[Finding]:
    agreement, names = pairwise_agreement(regions, cameras), tuple(map(str, range(len(cameras))))
    return pose_findings(agreement, names) + group_findings(agreement, names)


def judge(found: list[Finding], cameras: Cameras, faulty: set[int]) -> str:
    """What the findings say of a fault: the right views (or all others, which of two halves is wrong nobody can tell),
    these among others, the whole scene, or nothing."""
    level = "error" if any(each.level == "error" for each in found) else "warning"
    if not found:
        return "nothing"
    if any(not each.views for each in found):
        return f"{level}: whole scene"
    named = {view for each in found for view in each.views}
    sides = faulty, set(range(len(cameras))) - faulty
    right = "exactly" if named in sides else "some right" if named & faulty else "wrong"
    return f"{level}: views ({right})" if faulty else f"{level}: views"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--photos", action="store_true", help="ask the photos instead of the masks")
    args = parser.parse_args()
    faults = BY_PHOTOS if args.photos else FAULTS
    said: dict[tuple[str, str, str], Counter[str]] = defaultdict(Counter)
    for spec in chosen_scenes(args):
        scene = load_maps(spec, args.cache)
        views = "3 views" if spec.num_views == 3 else "5 to 20 views"
        if args.photos:
            photos = load_photos(spec, args.cache)
            shared = match_photos(photos.__getitem__, scene.cameras)
            names = tuple(map(str, range(len(photos))))
            asked = {"photos": lambda cameras, shared=shared, names=names: distance_findings(shared, cameras, names)}
        else:
            asked = {kind: partial(ask_masks, scene.masks(kind)[0]) for kind in KINDS}
        for kind, ask in asked.items():
            for fault in faults:
                cameras, faulty = put_fault(scene.cameras, fault)
                said[views, kind, fault][judge(ask(cameras), cameras, faulty)] += 1
    for (views, kind, fault), counts in sorted(said.items(), key=lambda item: (item[0][:2], faults.index(item[0][2]))):
        print(f"{views:14} {kind:9} {fault:26}", ", ".join(f"{count} {what}" for what, count in counts.most_common()))


if __name__ == "__main__":
    main()
