"""What does a detector find, and what does the cluster-aware loop add? `python -m benchmarks.detector --scenes DIR ...`

Scenes are folders as `mvseg simulate` writes them (photos, true label images, true leaf meshes) or others with the same
layout; without `truth/leaves` there are no figures for hidden leaves. With `--photos DIR --labels DIR [--every N]` in
their place, single photos, or every n-th of them, answer the first question. Three questions:

1. Average precision of the detector alone, photo by photo (all detections with a class score of 0.05 or more), and, of
   those that score `--min_score` or more, symmetric best Dice and the difference in count, see `count_and_dice`; and
   the processor time, with reading the photos and writing down the masks.
2. The loop, for detections with a score of `--min_score` or more: plain NMS against cluster-aware NMS after 1, 2, 3
   iterations, and after one with cross-view verification. Mask AP, precision, recall of all leaves, and recall of
   leaves that are less than half visible (visible pixels against the silhouette that the leaf would have alone). What
   lies mostly where the truth ignores it counts for nothing.
3. The ids of the detections: s_match, e_k and ARI over those that find a leaf (see `found_leaves`), pair F1 over all
   true masks, and MV-PQ, the panoptic quality of whole leaves (see `mvseg.evaluation.panoptic`).
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from pycocotools import mask as coco_mask
from tqdm import tqdm

from benchmarks.choice import true_maps
from benchmarks.found_leaves import credit_masks, is_found
from mvseg.detection.config import DetectConfig
from mvseg.detectors.zoo import load_detector
from mvseg.evaluation.average_precision import Annotations, annotate_truth, average_precision, describe_mask
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks
from mvseg.pipeline.mask_rcnn import MultiViewMaskRCNN
from mvseg.regions import IGNORE_LABEL, Regions
from mvseg.scene import Cameras, Scene
from mvseg.training.data import SampleList, list_samples, read_sample
from mvseg.training.loop import detect_and_label

MEANS = ("s_match", "e_k", "ari", "all_pair_f1", "mv_pq")  # over the scenes; all else is pooled
HIDDEN = 0.5  # a leaf is hidden when less than this share of it is visible


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """The D visible leaves of a scene: their regions, V label maps (65535 = ignore), (D,) bool, which are hidden."""

    regions: Regions
    maps: list[np.ndarray]
    is_hidden: torch.Tensor


def list_photos(folders: list[Path]) -> SampleList:
    """The photos of all scenes with their true labels."""
    lists = [list_samples(folder / "images", folder / "truth") for folder in folders]
    return SampleList(tuple(sample for of_scene in lists for sample in of_scene.samples), ("leaf",))


def count_and_dice(
    truth: Annotations, detections: Annotations, num_images: int, *, min_score: float
) -> dict[str, float]:
    """Symmetric best Dice and the difference in count, as the CVPPP leaf segmentation challenge judges photos.

    Scharr et al., "Leaf segmentation in plant phenotyping: a collation study", Machine Vision and Applications 2016.

    Means over the photos, whose image ids are 0..num_images - 1. Categories are not told apart, and ignored areas
    (crowds) are left out of the truth. Masks of detections may overlap. "sbd" is the smaller of the mean best Dice of
    the true masks among the detections and the reverse, in [0, 1]; 1 for a photo without leaves and detections, 0 for
    one with only either. "count_difference" is detections minus leaves, "absolute_count_difference" its absolute value,
    photo by photo. Raises ValueError: no images.
    """
    if num_images < 1:
        raise ValueError("no images, expected at least one")
    dice, difference = np.zeros(num_images), np.zeros(num_images)
    for image in range(num_images):
        true = [each["segmentation"] for each in truth if each["image_id"] == image and not each["iscrowd"]]
        found = [
            each["segmentation"] for each in detections if each["image_id"] == image and each["score"] >= min_score
        ]
        difference[image] = len(found) - len(true)
        if not true or not found:
            dice[image] = float(not true and not found)
            continue
        iou = coco_mask.iou(found, true, [0] * len(true))
        dices = 2 * iou / (1 + iou)
        dice[image] = min(dices.max(0).mean(), dices.max(1).mean())
    return {
        "sbd": float(dice.mean()),
        "count_difference": float(difference.mean()),
        "absolute_count_difference": float(np.abs(difference).mean()),
    }


def visible_share(folder: Path, cameras: Cameras, truth: Regions) -> np.ndarray:
    """(D,) visible pixels of each true region over those of its leaf's silhouette alone; NaN without meshes."""
    share = np.full(len(truth), np.nan)
    for index, (view, leaf) in enumerate(zip(truth.view_index.tolist(), truth.labels.tolist(), strict=True)):
        path = folder / "truth" / "leaves" / f"leaf_{leaf:03d}.ply"
        if path.is_file():
            mesh = trimesh.load_mesh(path, process=False)
            share[index] = min(1.0, int(truth.areas[index]) / max(1, silhouette_area(mesh, cameras, view)))
    return share


def silhouette_area(mesh: trimesh.Trimesh, cameras: Cameras, view: int) -> int:
    """Pixels inside the image that a mesh covers when nothing hides it."""
    K, R, t = (x[view].numpy() for x in (cameras.K, cameras.R, cameras.t))
    seen = (mesh.vertices @ R.T + t) @ K.T
    width, height = cameras.sizes[view].tolist()
    frame = np.zeros((height, width), np.uint8)
    # pixel centres at half integers; 4 binary digits below the pixel
    corners = np.rint((seen[:, :2] / seen[:, 2:] - 0.5) * 16).astype(np.int32)
    for triangle in corners[mesh.faces]:
        cv2.fillConvexPoly(frame, triangle, 1, shift=4)
    return int(frame.sum())


def annotate(masks: Masks, sizes: list[list[int]], first_image: int) -> list[dict[str, Any]]:
    """COCO annotations of the detections of one scene."""
    annotations = []
    for index, view in enumerate(masks.view_index.tolist()):
        described = describe_mask(masks.regions.mask(index, *sizes[view]), first_image + view)
        score = float(masks.detection_scores[index])
        annotations.append({**described, "category_id": 1, "iscrowd": 0, "score": score})
    return annotations


def build_model(args: argparse.Namespace, row: str) -> MultiViewMaskRCNN:
    """The model of a row of the table: "plain 0.5" is NMS without clusters, a number is that many iterations, and with
    "verified" behind it the other views correct what they leave."""
    detector = load_detector(args.weights, image_size=args.image_size, min_score=args.min_score)
    is_plain, number = row.startswith("plain"), row.removeprefix("plain").split()[0]
    return MultiViewMaskRCNN(
        detector,
        num_iterations=0 if is_plain else int(number),
        cluster_iou=float(number) if is_plain else 0.3,
        verify=row.endswith("verified"),
    )


def read_truth(folder: Path, scene: Scene) -> SceneTruth:
    regions = load_masks(scene, folder / "truth")
    is_hidden = torch.from_numpy(visible_share(folder, scene.cameras, regions) < HIDDEN)
    return SceneTruth(regions, true_maps(folder, scene), is_hidden)


def count_found(masks: Masks, truth: SceneTruth) -> dict[str, float]:
    """Numbers of true regions and of detections, and how right the ids of those detections are that find a leaf."""
    credited = credit_masks(masks.regions, masks.detection_scores, truth.maps)
    right, found = credited > 0, is_found(truth.regions, masks.regions, credited)
    is_ignored = (true_instances(masks.regions, truth.maps) == IGNORE_LABEL) & ~right
    ids = matching_metrics(masks.instance_ids[right], credited[right])
    leaves = leaf_metrics(masks.regions, masks.instance_ids, truth.maps)
    return {
        "found": int(found.sum()),
        "true": len(found),
        "right": int(right.sum()),
        "detections": len(right) - int(is_ignored.sum()),
        "hidden_found": int((found & truth.is_hidden).sum()),
        "hidden": int(truth.is_hidden.sum()),
        "s_match": ids.s_match,
        "e_k": ids.e_k,
        "ari": ids.ari,
        "all_pair_f1": leaves.all_pair_f1,
        "mv_pq": leaves.mv_pq,
    }


def measure_loop(folders: list[Path], args: argparse.Namespace) -> dict[str, dict[str, float | None]]:
    """Mask AP, precision and recalls of every row, pooled over the scenes, and the means of `MEANS` over them."""
    rows = ["plain 0.3", "plain 0.5", *[str(n) for n in range(1, args.iterations + 1)], "1 verified"]
    totals: dict[str, Counter[str]] = {row: Counter() for row in rows}
    truths: list[dict[str, Any]] = []
    detections: dict[str, list[dict[str, Any]]] = {row: [] for row in rows}
    num_images = 0
    for folder in tqdm(folders, "scenes"):
        scene = load_scene(folder)
        photos, truth = load_photos(scene), read_truth(folder, scene)
        by_name = {Path(sample.name).stem: sample for sample in list_photos([folder]).samples}
        for view, name in enumerate(view.name for view in scene.views):
            truths += annotate_truth(read_sample(by_name[Path(name).stem]), num_images + view, 1)
        for row in rows:
            masks = build_model(args, row).find_regions(photos, scene.cameras).masks
            detections[row] += annotate(masks, scene.cameras.sizes.tolist(), num_images)
            totals[row].update(count_found(masks, truth))
        num_images += len(photos)
    table: dict[str, dict[str, float | None]] = {}
    for row, total in totals.items():
        scores = average_precision(truths, detections[row], num_images)
        table[row] = {
            "mask_AP": scores["mask_AP"],
            "mask_AP50": scores["mask_AP50"],
            "precision": total["right"] / max(1, total["detections"]),
            "recall": total["found"] / total["true"],
            "recall_hidden": total["hidden_found"] / max(1, total["hidden"]),
        } | {name: total[name] / len(folders) for name in MEANS}
    table["leaves"] = {"visible": total["true"], "less_than_half_visible": total["hidden"]}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", default=[], help="scene folders with truth/")
    parser.add_argument("--photos", type=Path, help="in place of scenes: a folder of photos")
    parser.add_argument("--labels", type=Path, help="of --photos: a folder of label PNGs, or a COCO file")
    parser.add_argument("--every", type=int, default=1, help="every n-th of --photos only, see hold_out_every")
    parser.add_argument("--weights", default=DetectConfig.weights)
    parser.add_argument("--image_size", type=int, help="longer side of scaled photos (default: as the weights say)")
    parser.add_argument("--min_score", type=float, default=DetectConfig.min_score, help="of detections in the loop")
    parser.add_argument("--iterations", type=int, default=3, help="of the loop at most; 0 for average precision alone")
    args = parser.parse_args()
    if bool(args.scenes) == bool(args.photos) or bool(args.photos) != bool(args.labels):
        parser.error("expected either --scenes, or --photos and --labels")
    samples = list_photos(args.scenes) if args.scenes else list_samples(args.photos, args.labels)
    samples = samples.select(range(0, len(samples), args.every))
    indices = tqdm(range(len(samples)), "photos")
    detector = load_detector(args.weights, image_size=args.image_size)
    start = time.process_time()
    truth, detections = detect_and_label(detector, samples, indices)
    seconds = time.process_time() - start
    alone = average_precision(truth, detections, len(samples))
    alone |= count_and_dice(truth, detections, len(samples), min_score=args.min_score)
    alone["cpu_seconds_per_photo"] = seconds / len(samples)
    print(len(samples), "photos", alone)
    if args.scenes and args.iterations:
        for row, values in measure_loop(args.scenes, args).items():
            print(f"{row:12}", "  ".join(f"{name} {value:.3f}" for name, value in values.items()))


if __name__ == "__main__":
    main()
