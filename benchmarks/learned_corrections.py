"""What a detector learns from corrections: `python benchmarks/learned_corrections.py BASIL --out DIR --val DATA/val.json`

The simulated person of `corrections.py` corrects every third photo of a plant, and no others; `mvseg train
--from_results` learns from the result for a few minutes, simulated photos mixed in. Then the detector alone is judged,
before and after: on the photos that nobody corrected (precision and recall of masks with scores from 0.3 on, and AP50),
and, for what it forgot, on simulated photos (--val, every --every-th). Steps whose files are in the folder are not run again.
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

from benchmarks.corrections import Case, compute
from benchmarks.mask_fates import true_maps
from benchmarks.simulated_person import Labels, Look, count_worth, list_repairs
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections, Edit, Link, load_corrections, write_corrections
from mvseg.detection.config import DetectConfig
from mvseg.detectors.zoo import load_detector
from mvseg.errors import InputWarning
from mvseg.evaluation.average_precision import average_precision
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.scene_folder import load_scene
from mvseg.pipeline import State, detect, load
from mvseg.regions import Regions, mask_box, stack_regions
from mvseg.results.folder import save_result
from mvseg.results.result import Result
from mvseg.training.data import SampleList, list_samples
from mvseg.training.loop import TrainConfig, train
from mvseg.training.validation import detect_and_label

EVERY = 3  # of the photos, one is corrected
LOOKS = 1  # rounds of the person


def correct_photos(case: Case, names: set[str]) -> tuple[Edit, ...]:
    """What the person says of the masks in some photos, until they are right, and of the ids of these masks."""
    edits: tuple[Edit, ...] = ()
    for _ in range(LOOKS):
        state = compute(case, Corrections(edits))
        done = {str(edit.by) for edit in edits}
        for each in list_repairs(Look(state.matched.masks.to("cpu"), case.truth, state.scene, [])):
            last = each.edits[-1]
            places = {place[0] for place in last.at[1:]} if isinstance(last, Link) else {last.view}
            if places <= names and each.name not in done:
                edits += tuple(edit.model_copy(update={"by": each.name}) for edit in each.edits)
    return edits


def write_corrected(state: State, scene: Path, out: Path) -> None:
    """A result folder as `mvseg infer --corrections` writes it, without shapes."""
    result = Result(
        scene=state.scene,
        matching=state.matched,
        photos=state.photos,
        corrections=state.corrections,
        fates=() if state.corrected is None else state.corrected.fates,
    )
    save_result(result, out, {"config": {"scene": str(scene)}}, report=False)


def learn(results: Path, out: Path, epochs: int) -> Path:
    """The weights that a run from the shipped detector on these results ends with: a simulated photo for each real one."""
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
    detector = load_detector(weights)
    labelled, found = detect_and_label(detector, photos, tqdm(range(len(photos)), "photos"))
    scores = average_precision(labelled, found, len(photos))
    answer: dict[str, float | None] = {"AP50": scores["mask_AP50"]}
    if truth:
        regions = _as_regions([each for each in found if each["score"] >= DetectConfig.min_score], truth)
        whole = leaf_metrics(regions, torch.full((len(regions),), -1), truth)
        answer |= {"precision": whole.mask_precision, "recall": whole.mask_recall}
    return answer


def _as_regions(found: list[dict[str, Any]], truth: list[Labels]) -> Regions:
    """Detections as regions; each is cut to its box."""
    masks = []
    for each in found:
        height, width = truth[each["image_id"]].shape
        mask = torch.from_numpy(decode_segmentation(each["segmentation"], width, height))
        if mask.any():
            masks.append((each["image_id"], mask_box(mask), mask))
    crops = [mask[y1:y2, x1:x2].flatten() for _, (x1, y1, x2, y2), mask in masks]
    views, boxes = [view for view, _, _ in masks], [box for _, box, _ in masks]
    return stack_regions(views, boxes, crops, labels=range(len(masks)), num_views=len(truth))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with photos and truth/")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--keep", type=Path, help="folder of detections, see run_scene")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--val", type=Path, help="COCO file of simulated photos, beside their folders")
    parser.add_argument("--every", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    scene = load_scene(args.scene)
    truth, names = true_maps(args.scene, scene), [view.name for view in scene.views]
    path = args.out / "corrections.json"
    if not (args.out / "corrected").exists():
        args.out.mkdir(parents=True, exist_ok=True)
        found = detect(load(args.scene, None, RunConfig(reconstruct=None), keep=args.keep))
        case = Case(args.scene.name, found, truth, has_masks=False)
        edits = load_corrections(path).edits if path.exists() else correct_photos(case, set(names[::EVERY]))
        write_corrections(path, Corrections(edits))
        write_corrected(compute(case, Corrections(edits)), args.scene, args.out / "corrected")
    edits = load_corrections(path).edits
    print(f"{len(edits)} edits, worth {count_worth(edits)}, in photos {', '.join(names[::EVERY])}")
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
