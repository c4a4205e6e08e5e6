"""What a detector learns from corrections: `python benchmarks/learned_corrections.py BASIL RESULT --out DIR`

RESULT is what `mvseg infer BASIL` found. The simulated person of `corrections.py` corrects the masks of every third
photo, and no others; `mvseg train --from_results` learns from that for some minutes, simulated photos mixed in. Then
the detector alone is judged, before and after: on the photos that nobody corrected (precision and recall of masks
with scores from 0.3 on, and AP50), and, for what it forgot, on simulated photos (--val, every --every-th). What the
views make of corrections in the other photos is left out here. Steps whose files are in the folder are not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.choice import true_maps
from benchmarks.masks_alone import change_masks_alone
from benchmarks.simulated_person import Labels, Look, count_worth, list_repairs
from mvseg.corrections.file import Corrections, Edit, Outline, Reject, Split, load_corrections, write_corrections
from mvseg.detection.config import DetectConfig
from mvseg.detectors.zoo import load_detector
from mvseg.errors import InputWarning
from mvseg.evaluation.average_precision import average_precision
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions, mask_box, stack_regions
from mvseg.results.folder import save_result
from mvseg.results.read import load_result
from mvseg.results.result import Result
from mvseg.scene import Scene
from mvseg.training.data import SampleList, list_samples
from mvseg.training.loop import TrainConfig, train
from mvseg.training.validation import detect_and_label

EVERY = 3  # of the photos, one is corrected
SIZE = 800  # longer side at which photos are looked at, whatever size the weights were trained at


def correct_photos(masks: Masks, truth: list[Labels], *, scene: Scene, names: set[str]) -> tuple[Edit, ...]:
    """What the person says of the masks in some photos: those that are no leaves, and outlines of what has none."""
    edits: tuple[Edit, ...] = ()
    for each in list_repairs(Look(masks, truth, scene, [])):
        edits += tuple(edit for edit in each.edits if isinstance(edit, Outline | Reject | Split) and edit.view in names)
    return edits


def write_corrected(masks: Masks, corrections: Corrections, *, scene: Scene, folder: Path, out: Path) -> None:
    """A result folder with these corrections, without shapes."""
    changed = change_masks_alone(masks, corrections.edits, scene)
    matching = Matching(changed, MatchReport("nview", has_probabilities=True))
    result = Result(scene=scene, matching=matching, photos=Photos(scene), corrections=corrections)
    save_result(result, out, {"config": {"scene": str(folder)}}, report=False)


def learn(results: Path, out: Path, epochs: int) -> Path:
    """The weights that a run from the shipped detector ends with; there is a simulated photo for each real one."""
    if not (out / "model.safetensors").exists():
        config = TrainConfig(
            output=out,
            from_results=results,
            new_plants=12,
            arch="efficientnet_lite0",
            weights=DetectConfig.weights,
            image_size=320,
            orientation="upright",
            scale_range=(2.5, 5.0),
            epochs=epochs,
            batch_size=4,
            images_per_forward=4,
            lr=2e-4,
            backbone_lr=0.25,
            warmup_steps=10,
            ema_decay=0.95,
            num_workers=0,
        )
        started = time.process_time()
        train(config)
        print(f"trained for {(time.process_time() - started) / 60:.1f} minutes of CPU")
    return out / "model.safetensors"


def judge_detector(weights: str, photos: SampleList, truth: list[Labels]) -> dict[str, float | None]:
    """AP50 on these photos and, of what scores enough, precision and recall of masks."""
    detector = load_detector(weights, image_size=SIZE)
    labelled, found = detect_and_label(detector, photos, tqdm(range(len(photos)), "photos"))
    scores = average_precision(labelled, found, len(photos))
    answer: dict[str, float | None] = {"AP50": scores["mask_AP50"]}
    if truth:
        sure = [each for each in found if each["score"] >= DetectConfig.min_score and each["area"] > 0]
        regions = _as_regions(sure, [[labels.shape[1], labels.shape[0]] for labels in truth])
        whole = leaf_metrics(regions, torch.full((len(regions),), -1), truth)
        answer |= {"precision": whole.mask_precision, "recall": whole.mask_recall}
    return answer


def _as_regions(found: list[dict[str, Any]], sizes: list[list[int]]) -> Regions:
    """COCO annotations as regions, in their order; `sizes` are widths and heights."""
    boxes, crops = [], []
    for each in found:
        mask = torch.from_numpy(decode_segmentation(each["segmentation"], *sizes[each["image_id"]]))
        x1, y1, x2, y2 = mask_box(mask)
        boxes.append((x1, y1, x2, y2))
        crops.append(mask[y1:y2, x1:x2].flatten())
    views = [each["image_id"] for each in found]
    return stack_regions(views, boxes, crops, labels=range(len(found)), num_views=len(sizes))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with photos and truth/")
    parser.add_argument("result", type=Path, help="what mvseg infer made of it")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--val", type=Path, help="COCO file of simulated photos, beside their folders")
    parser.add_argument("--every", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    scene = load_scene(args.scene)
    truth, names = true_maps(args.scene, scene), [view.name for view in scene.views]
    path = args.out / "corrections.json"
    if not (args.out / "corrected").exists():
        masks = load_result(args.result).masks
        corrections = Corrections(correct_photos(masks, truth, scene=scene, names=set(names[::EVERY])))
        args.out.mkdir(parents=True, exist_ok=True)
        write_corrections(path, corrections)
        write_corrected(masks, corrections, scene=scene, folder=args.scene, out=args.out / "corrected")
    edits = load_corrections(path).edits
    print(f"{len(edits)} edits, worth {count_worth(edits)}, in photos {', '.join(names[::EVERY])}", flush=True)
    weights = learn(args.out / "corrected", args.out / "run", args.epochs)
    every = list_samples(args.scene / "images", args.scene / "truth")
    others = [index for index in range(len(names)) if index % EVERY]
    tests = {"other photos": (every.select(others), [truth[index] for index in others])}
    if args.val is not None:
        samples = list_samples(args.val.parent, args.val)
        tests["simulated"] = (samples.select(range(0, len(samples), args.every)), [])
    for name, (photos, maps) in tests.items():
        for when, detector in (("before", DetectConfig.weights), ("after", str(weights))):
            record = args.out / f"{name} {when}.json"
            if not record.exists():
                record.write_text(json.dumps(judge_detector(detector, photos, maps)), encoding="utf-8")
            shown = json.loads(record.read_text(encoding="utf-8"))
            figures = ", ".join(f"{key} {value:.3f}" for key, value in shown.items())
            print(f"{name} ({len(photos)}), {when}: {figures}", flush=True)


if __name__ == "__main__":
    main()
