"""What outlines of a leaf bring in the other views: `python benchmarks/drawn_leaves.py SCENE ... [--groups 3]`

The scenes have photos, cameras and `truth/`; the detector finds their leaves. A person draws leaves, every third one in
each run, each in the two photos, and then the three, that show it best from different sides. Of the other photos that
show it openly (half as large as the largest or more), how many have a mask of it with an IoU above one half: of all
leaves that are shown so in `FEWEST` photos, and of those that the result without a person gets wrong. And harm:
leaves that nobody drew, and that were right before and are wrong now.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.corrections import Case, compute, detect_case
from benchmarks.simulated_person import Look
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import RIGHT_IOU
from mvseg.masks import Masks

OPEN, FEWEST = 0.5, 4


def open_views(visible: np.ndarray) -> list[int]:
    """The views that show a leaf openly, by its visible pixels (V,) in each; the largest first."""
    order = np.argsort(-visible, kind="stable")
    return [int(view) for view in order if visible[view] >= OPEN * visible.max() > 0]


def draw_from(case: Case, views: list[int], number: int) -> list[int]:
    """The first view, and then those from the most different sides."""
    centers = case.known.scene.cameras.centers.numpy()
    sights = centers - centers.mean(0)
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    chosen = [views[0]]
    while len(chosen) < min(number, len(views)):
        left = [view for view in views if view not in chosen]
        nearest = (sights[left] @ sights[chosen].T).max(1)
        chosen.append(left[int(np.round(nearest, 6).argmin())])
    return chosen


def shown_in(masks: Masks, truth: Sequence[np.ndarray], leaf: int, drawn: list[int], view: int) -> bool:
    """Whether a view has a mask of the instance of a leaf that was drawn in others, with an IoU above one half."""
    is_leaf = torch.zeros(len(masks), dtype=torch.bool)
    for row in range(len(masks)):
        if int(masks.view_index[row]) in drawn and masks.is_corrected[row]:
            x1, y1, x2, y2 = masks.regions.boxes[row].tolist()
            here = truth[int(masks.view_index[row])][y1:y2, x1:x2][masks.regions.crop(row).numpy()]
            is_leaf |= (masks.instance_ids == masks.instance_ids[row]) & bool((here == leaf).mean() > RIGHT_IOU)
    shown = masks.regions.label_map(view, is_leaf.long(), truth[view].shape[::-1]).numpy() > 0
    true = truth[view] == leaf
    return bool((shown & true).sum() > RIGHT_IOU * (shown | true).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--groups", type=int, default=3, help="runs that the leaves of a scene are shared out to")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    total = np.zeros((2, 2, 2), int)  # two or three outlines; all or missed leaves; views shown, views
    harm, drawn_leaves = 0, 0
    for folder in args.scenes:
        case, begun = detect_case(folder, RunConfig(reconstruct=None)), time.process_time()
        first = compute(case, Corrections()).masks.to("cpu")
        before = Look(first, case.truth, case.known.scene, ())
        views_of = {leaf: open_views(before.visible[:, leaf]) for leaf in range(1, len(before.size))}
        leaves = [leaf for leaf, views in views_of.items() if len(views) >= FEWEST]
        here = np.zeros_like(total)
        harmed = 0
        for number in (2, 3):
            for group in range(args.groups):
                chosen = {leaf: draw_from(case, views_of[leaf], number) for leaf in leaves[group :: args.groups]}
                edits = tuple(before.outline(leaf, view) for leaf, views in chosen.items() for view in views)
                masks = compute(case, Corrections(edits)).masks.to("cpu")
                for leaf, drawn in chosen.items():
                    others = [view for view in views_of[leaf] if view not in drawn]
                    found = sum(shown_in(masks, case.truth, leaf, drawn, view) for view in others)
                    here[number - 2, 0] += found, len(others)
                    if leaf not in before.right:
                        here[number - 2, 1] += found, len(others)
                after = Look(masks, case.truth, case.known.scene, ()).right
                harmed += len(before.right - after - set(chosen))
                drawn_leaves += len(chosen)
        total, harm = total + here, harm + harmed
        print(describe(folder.name, here, harmed), f"{time.process_time() - begun:6.0f} s", flush=True)
    print(describe("all", total, harm), f"of {drawn_leaves} leaves drawn")


def describe(name: str, counts: np.ndarray, harmed: int) -> str:
    cells = [f"{found:4} of {views:4} {found / max(views, 1):5.2f}" for found, views in counts.reshape(-1, 2)]
    return f"{name:22} two: {cells[0]}, missed {cells[1]}; three: {cells[2]}, missed {cells[3]}; harmed {harmed}"


if __name__ == "__main__":
    main()
