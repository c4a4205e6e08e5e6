"""Does cluster-aware NMS save half-hidden leaves, and at what price? `python benchmarks/nms_recall.py [--plants 6]`

Simulated plants, simulated proposals (jittered true boxes and masks, five of each leaf). A leaf is found when a kept
mask has an IoU of 0.5 with it; each mask finds at most one leaf. "crowded" leaves are those whose box has an IoU above
0.5 with another leaf's box in the same view.
"""

from __future__ import annotations

import argparse
import json

import torch
import torchvision

from mvseg.matching.config import MatchConfig
from mvseg.multiview.loop import match_proposals
from mvseg.multiview.nms import cluster_aware_nms
from mvseg.multiview.proposals import Proposals
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.dataset import drop_small
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.proposals import simulate_proposals
from mvseg.simulation.ray_cast import build_stage, render_stage

FAMILIES = ("ovate", "rosette", "lanceolate", "lobed", "compound", "strap")


def mask_iou(regions: Regions, truth: Regions, view: int, width: int, height: int) -> torch.Tensor:
    """(N, M) IoU of the masks of one view."""
    stacks = []
    for some in (regions, truth):
        here = (some.view_index == view).nonzero()[:, 0].tolist()
        frames = [some.mask(n, width, height).flatten() for n in here]
        stacks.append(torch.stack(frames).float() if frames else torch.zeros(0, width * height))
    common = stacks[0] @ stacks[1].T
    return common / (stacks[0].sum(1)[:, None] + stacks[1].sum(1) - common).clamp(min=1)


def found_leaves(proposals: Proposals, keep: torch.Tensor, truth: Regions, size: list[int]) -> torch.Tensor:
    """(D,) bool: which true regions are found, best scores first."""
    found = torch.zeros(len(truth), dtype=torch.bool)
    for view in range(truth.num_views):
        here = keep[proposals.regions.view_index[keep] == view]
        there = (truth.view_index == view).nonzero()[:, 0]
        iou = mask_iou(proposals.regions.select(here), truth, view, *size)
        for row in iou[proposals.scores[here].argsort(descending=True)]:
            if len(row) and (best := int((row * ~found[there]).argmax())) >= 0 and row[best] >= 0.5:
                found[there[best]] |= True
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=6)
    parser.add_argument("--leaves", type=int, default=24)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--method", default="auto", help="of matching: symnmf, one-per-view, nview or auto")
    args = parser.parse_args()
    totals: dict[str, list[int]] = {}
    for seed in range(args.plants):
        plant = grow_plant(FAMILIES[seed % len(FAMILIES)], args.leaves, seed=100 + seed)
        cameras = arc_cameras(args.views, plant)
        size = cameras.sizes[0].tolist()
        stage = build_stage(plant, seed=seed)
        poses = zip(cameras.K.numpy(), cameras.R.numpy(), cameras.t.numpy(), strict=True)
        maps = [drop_small(render_stage(stage, K, R, t, *size).ids, 30) for K, R, t in poses]
        truth = regions_from_label_maps(maps)
        proposals, _ = simulate_proposals(maps, seed=seed)
        excess = cluster_aware_nms(proposals.boxes, proposals.scores, proposals.regions.view_index, 0.7)
        proposals = Proposals(
            proposals.regions.select(excess),
            proposals.boxes[excess],
            proposals.scores[excess],
            proposals.classes[excess],
        )
        overlap = torchvision.ops.box_iou(truth.boxes.float(), truth.boxes.float()).fill_diagonal_(0)
        overlap[truth.view_index[:, None] != truth.view_index] = 0
        crowded = (overlap > 0.5).any(1)
        runs = {
            f"plain NMS {iou}": cluster_aware_nms(proposals.boxes, proposals.scores, proposals.regions.view_index, iou)
            for iou in (0.3, 0.5, 0.7)
        }
        for iterations in (1, 2, 3):
            keep, _ = match_proposals(
                proposals, cameras, num_iterations=iterations, match=MatchConfig(method=args.method)
            )
            runs[f"cluster-aware, {iterations} iterations"] = keep
        for name, keep in runs.items():
            found = found_leaves(proposals, keep, truth, size)
            counts = [int(found.sum()), len(truth), int(found[crowded].sum()), int(crowded.sum()), len(keep)]
            totals[name] = [a + b for a, b in zip(totals.get(name, [0] * 5), counts, strict=True)]
    report = {
        name: {
            "recall": round(found / of, 3),
            "recall crowded": round(crowd / max(of_crowd, 1), 3),
            "precision": round(found / kept, 3),
            "kept": kept,
        }
        for name, (found, of, crowd, of_crowd, kept) in totals.items()
    }
    print(
        json.dumps(
            {"crowded": next(iter(totals.values()))[3], "leaves": next(iter(totals.values()))[1]} | report, indent=1
        )
    )


if __name__ == "__main__":
    main()
