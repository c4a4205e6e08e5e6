"""What does a detector find, and what does the cluster-aware loop add? `python benchmarks/detector.py --scenes DIR ...`

Scenes are folders as `mvseg simulate` writes them (photos, true label images, true leaf meshes) or anything in the same
layout; without `truth/leaves` nothing is said about hidden leaves. Three questions:

1. Average precision of the detector alone, photo by photo (all that torchvision's class score puts at 0.05 or more).
2. The loop: of what scores at least `--min_score`, plain NMS against cluster-aware NMS after 0, 1, 2, 3 iterations:
   mask AP, precision, recall of all leaves and of those less than half visible (visible pixels against the silhouette
   that the leaf would have alone).
3. The ids given to what was found: s_match, e_k and ARI over the detections that show a leaf (IoU >= 0.5).
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from tqdm import tqdm

from mvseg.detectors.zoo import load_detector
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.multiview.config import DetectConfig
from mvseg.multiview.mask_rcnn import MultiViewMaskRCNN
from mvseg.multiview.proposals import Proposals
from mvseg.regions import Regions
from mvseg.scene import Cameras, Scene
from mvseg.training.average_precision import annotate_truth, average_precision, describe_mask, detect_and_label
from mvseg.training.data import SampleList, list_samples, read_sample

FOUND_IOU = 0.5
HIDDEN = 0.5  # less than this share visible


def list_photos(folders: list[Path]) -> SampleList:
    """The photos of all scenes with their true labels."""
    lists = [list_samples(folder / "images", folder / "truth") for folder in folders]
    return SampleList(tuple(sample for one in lists for sample in one.samples), ("leaf",))


def visible_share(folder: Path, cameras: Cameras, truth: Regions) -> np.ndarray:
    """(D,) visible pixels of each true region against the silhouette of its leaf alone; NaN without meshes."""
    share = np.full(len(truth), np.nan)
    for number, (view, leaf) in enumerate(zip(truth.view_index.tolist(), truth.labels.tolist(), strict=True)):
        path = folder / "truth" / "leaves" / f"leaf_{leaf:03d}.ply"
        if path.is_file():
            mesh = trimesh.load(path, process=False)
            share[number] = min(1.0, int(truth.areas[number]) / max(1, silhouette_area(mesh, cameras, view)))
    return share


def silhouette_area(mesh: trimesh.Trimesh, cameras: Cameras, view: int) -> int:
    """Pixels inside the image that a mesh covers when nothing stands before it."""
    K, R, t = (x[view].numpy() for x in (cameras.K, cameras.R, cameras.t))
    seen = (mesh.vertices @ R.T + t) @ K.T
    width, height = cameras.sizes[view].tolist()
    frame = np.zeros((height, width), np.uint8)
    # pixel centres at half integers; 4 binary digits below the pixel
    corners = np.rint((seen[:, :2] / seen[:, 2:] - 0.5) * 16).astype(np.int32)
    for triangle in corners[mesh.faces]:
        cv2.fillConvexPoly(frame, triangle, 1, shift=4)
    return int(frame.sum())


def pair_up(found: Regions, truth: Regions, sizes: list[list[int]], scores: torch.Tensor) -> np.ndarray:
    """(N,) index of the true region that each detection shows, best scores first, or -1."""
    shows = np.full(len(found), -1)
    for view, size in enumerate(sizes):
        here, there = ((some.view_index == view).nonzero()[:, 0] for some in (found, truth))
        if not len(here) or not len(there):
            continue
        a, b = (
            torch.stack([some.mask(n, *size).flatten() for n in index.tolist()]).float()
            for some, index in ((found, here), (truth, there))
        )
        common = a @ b.T
        iou = (common / (a.sum(1)[:, None] + b.sum(1) - common)).numpy()
        for row in scores[here].argsort(descending=True).tolist():
            best = int(iou[row].argmax())
            if iou[row, best] >= FOUND_IOU:
                shows[int(here[row])] = int(there[best])
                iou[:, best] = -1
    return shows


def annotate(found: Proposals, sizes: list[list[int]], first_image: int) -> list[dict[str, Any]]:
    """COCO annotations of the detections of one scene."""
    annotations = []
    for number, view in enumerate(found.regions.view_index.tolist()):
        described = describe_mask(found.regions.mask(number, *sizes[view]), first_image + view)
        annotations.append({**described, "category_id": 1, "iscrowd": 0, "score": float(found.scores[number])})
    return annotations


def run_loop(scene: Scene, photos: list[torch.Tensor], args: argparse.Namespace, row: str) -> tuple[Proposals, Any]:
    """One row of the table: "plain 0.5" is NMS without clusters, a number is that many iterations."""
    detector = load_detector(args.weights, image_size=args.image_size, min_score=args.min_score)
    plain = row.startswith("plain")
    model = MultiViewMaskRCNN(
        detector, num_iterations=0 if plain else int(row), cluster_iou=float(row.split()[1]) if plain else 0.3
    )
    return model.find_regions(photos, scene.cameras)


def measure_loop(folders: list[Path], args: argparse.Namespace) -> dict[str, dict[str, float | None]]:
    """Mask AP, precision, recalls and ids of every row, pooled over the scenes (ids: mean over the scenes)."""
    rows = ["plain 0.3", "plain 0.5", *[str(n) for n in range(1, args.iterations + 1)]]
    counts: dict[str, dict[str, list[float]]] = {row: defaultdict(list) for row in rows}
    truths: list[dict[str, Any]] = []
    detections: dict[str, list[dict[str, Any]]] = {row: [] for row in rows}
    num_images = 0
    for folder in tqdm(folders, "scenes"):
        scene = load_scene(folder)
        photos, truth = load_photos(scene), load_masks(scene, folder / "truth")
        sizes = scene.cameras.sizes.tolist()
        hidden = visible_share(folder, scene.cameras, truth) < HIDDEN
        by_name = {Path(sample.name).stem: sample for sample in list_photos([folder]).samples}
        for view, name in enumerate(view.name for view in scene.views):
            truths += annotate_truth(read_sample(by_name[Path(name).stem]), num_images + view, 1)
        for row in rows:
            found, matching = run_loop(scene, photos, args, row)
            shows = pair_up(found.regions, truth, sizes, found.scores)
            hit = np.isin(np.arange(len(truth)), shows)
            detections[row] += annotate(found, sizes, num_images)
            good = shows >= 0
            ids = matching_metrics(matching.instance_ids[torch.from_numpy(good)], truth.labels[shows[good]])
            values = {"found": hit.sum(), "true": len(hit), "right": good.sum(), "detections": len(good)}
            values |= {"hidden_found": (hit & hidden).sum(), "hidden": hidden.sum()}
            values |= {"s_match": ids.s_match, "e_k": ids.e_k, "ari": ids.ari}
            for name, value in values.items():
                counts[row][name].append(float(value))
        num_images += len(photos)
    table: dict[str, dict[str, float | None]] = {}
    for row in rows:
        total = {name: sum(values) for name, values in counts[row].items()}
        scores = average_precision(truths, detections[row], num_images)
        table[row] = {
            "mask_AP": scores["mask_AP"],
            "mask_AP50": scores["mask_AP50"],
            "precision": total["right"] / max(1, total["detections"]),
            "recall": total["found"] / total["true"],
            "recall_hidden": total["hidden_found"] / max(1, total["hidden"]),
        } | {name: total[name] / len(folders) for name in ("s_match", "e_k", "ari")}
    table["leaves"] = {"visible": total["true"], "less_than_half_visible": total["hidden"]}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True, help="scene folders with truth/")
    parser.add_argument("--weights", default="leaf-slim")
    parser.add_argument("--image_size", type=int, help="longer side that photos are scaled to (what the weights say)")
    parser.add_argument("--min_score", type=float, default=DetectConfig.min_score, help="of the loop's detections")
    parser.add_argument("--iterations", type=int, default=3, help="0 for average precision alone")
    parser.add_argument("--json", type=Path, help="write the figures here")
    args = parser.parse_args()
    samples = list_photos(args.scenes)
    shown = tqdm(range(len(samples)), "photos")
    detector = load_detector(args.weights, image_size=args.image_size)
    alone = average_precision(*detect_and_label(detector, samples, shown, torch.device("cpu")), len(samples))
    print(json.dumps(alone))
    report: dict[str, Any] = {"num_photos": len(samples), "detector": alone}
    if args.iterations:
        report["loop"] = measure_loop(args.scenes, args)
        for row, values in report["loop"].items():
            print(f"{row:10}", "  ".join(f"{name} {value:.3f}" for name, value in values.items()))
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
