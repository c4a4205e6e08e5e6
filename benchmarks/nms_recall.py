"""Does cluster-aware NMS save half-hidden leaves, and at what price? `python benchmarks/nms_recall.py [--plants 6]`

Simulated plants, simulated proposals (jittered true boxes and masks, five of each leaf). See `found_leaves` for what
counts as found. "crowded" leaves are those whose box has an IoU above 0.5 with another leaf's box in the same view.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torchvision.ops import box_iou

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.found_leaves import credit_masks, is_found
from mvseg.detection.loop import match_proposals
from mvseg.detection.nms import cluster_aware_nms
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.ray_cast import build_stage, render_stage
from mvseg.simulation.scene_writer import drop_small
from simulated_proposals import simulate_proposals

FAMILIES = ("ovate", "rosette", "lanceolate", "lobed", "compound", "strap")


def is_crowded(truth: Regions) -> torch.Tensor:
    """(D,) bool."""
    overlap = box_iou(truth.boxes.float(), truth.boxes.float()).fill_diagonal_(0)
    overlap[truth.view_index[:, None] != truth.view_index] = 0
    return (overlap > 0.5).any(1)


def plain_nms(proposals: Masks, iou: float) -> torch.Tensor:
    """Indices of the proposals that are kept."""
    boxes, scores = proposals.regions.boxes.float(), proposals.detection_scores
    return cluster_aware_nms(boxes, scores, proposals.view_index, iou)


def run_all_nms(proposals: Masks, cameras: Cameras, match: MatchConfig) -> dict[str, torch.Tensor]:
    """{row of the table: indices of the proposals that are kept}."""
    kept = {f"plain NMS {iou}": plain_nms(proposals, iou) for iou in (0.3, 0.5, 0.7)}
    for iterations in (1, 2, 3):
        matching = match_proposals(proposals, cameras, num_iterations=iterations, match=match)
        kept[f"cluster-aware, {iterations} iterations"] = matching.masks.regions.labels
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=6)
    parser.add_argument("--leaves", type=int, default=24)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--method", default="auto", help="of matching: symnmf, one-per-view, nview or auto")
    args = parser.parse_args()
    totals: dict[str, torch.Tensor] = {}
    num_leaves = num_crowded = 0
    for seed in range(args.plants):
        plant = grow_plant(FAMILIES[seed % len(FAMILIES)], args.leaves, seed=100 + seed)
        cameras = arc_cameras(args.views, plant)
        stage = build_stage(plant, seed=seed)
        maps = [drop_small(render_stage(stage, cameras, view).ids, 30) for view in range(args.views)]
        truth = regions_from_label_maps(maps)
        crowded = is_crowded(truth)
        num_leaves, num_crowded = num_leaves + len(truth), num_crowded + int(crowded.sum())
        proposals, _ = simulate_proposals(maps, seed=seed)
        first = plain_nms(proposals, 0.7)
        proposals = proposals.select(first)
        proposals = replace(proposals, regions=replace(proposals.regions, labels=torch.arange(len(first))))
        for name, keep in run_all_nms(proposals, cameras, MatchConfig(method=args.method)).items():
            kept = proposals.regions.select(keep)
            found = is_found(truth, kept, credit_masks(kept, proposals.detection_scores[keep], maps))
            counts = torch.stack((found.sum(), found[crowded].sum(), torch.tensor(len(keep))))
            totals[name] = totals.get(name, 0) + counts
    report: dict[str, object] = {"crowded": num_crowded, "leaves": num_leaves}
    for name, counts in totals.items():
        found, found_crowded, kept = counts.tolist()
        report[name] = {
            "recall": round(found / num_leaves, 3),
            "recall crowded": round(found_crowded / max(num_crowded, 1), 3),
            "precision": round(found / kept, 3),
            "kept": kept,
        }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
