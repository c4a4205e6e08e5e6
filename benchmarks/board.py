"""One set of weights on all real plants at hand: `python benchmarks/board.py DATA --weights leaf-lite FILE`

DATA holds the real scenes, each in its folder; those that are missing are left out. One table, a row for
each scene and a column for each set of weights:

- basil-0729, whole job from photos to ids, against true masks: at default options, and mean and spread (standard
  deviation) over `--sizes` of the photos as they are and mirrored, cameras too: one look is a draw of dice.
- fern-llff (every second photo), maize-plant1: whole job at default options, counted without truth: masks that the
  detector finds, instances, those in three views or more, and the share of the masks in these. On the maize, masks of
  which less than half is on the plant's silhouette are false alarms.
- arabidopsis-romi, every tenth photo by itself: masks that are long and thin, and lie above the rosette: siliques,
  stems and pedicels that are taken for leaves.
- rosettes-cvppp-a1, 40 of the 80 photos that are not every fifth: mask AP50, symmetric best Dice, difference in count.

`--keep DIR` keeps detections and the mirrored photos for the next call, `--pictures DIR` draws what is found.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.best_dice import count_and_dice
from mvseg.config import RunConfig
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.config import DetectConfig
from mvseg.detectors.run import detect as detect_in_photo
from mvseg.detectors.zoo import load_detector
from mvseg.evaluation.average_precision import average_precision
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.formats.image_file import read_rgb, write_png
from mvseg.formats.label_png import read_label_png
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.open_scene import Opened
from mvseg.results.overlay import draw_overlay
from mvseg.scene import Scene
from mvseg.training.data import list_samples
from mvseg.training.validation import detect_and_label

SIZES = (640, 800, 1024)
MANY = 3  # views, from which an instance is well supported
SLENDER = 4.0  # length over width of what is no leaf of the rosette
ROSETTE = 0.85  # of the photo's height: the rosette lies below

Figures = dict[str, float]
Draw = Callable[[DetectConfig, Scene, str], tuple[Masks, Masks]]  # `find_masks` with some weights


def mirror_scene(scene: Scene, folder: Path) -> Scene:
    """The scene as a mirror shows it: photos (written to `folder`) and cameras; world and image x change their sign."""
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=scene.cameras.R.dtype)
    K = scene.cameras.K.clone()
    K[:, 0, 2] = scene.cameras.sizes[:, 0] - K[:, 0, 2]
    cameras = replace(scene.cameras, K=K, R=flip[:, None] * scene.cameras.R * flip, t=flip * scene.cameras.t)
    views = []
    for view in scene.views:
        assert view.lens is None, "a lens with distortion cannot be mirrored here"
        path = folder / f"{view.name}.png"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.ascontiguousarray(read_rgb(view.path)[:, ::-1]))
        views.append(replace(view, path=path))
    return Scene(f"{scene.name}-mirrored", tuple(views), cameras)


def find_masks(scene: Scene, options: DetectConfig, cache: Path | None) -> tuple[Masks, Masks]:
    """Masks as they are found and matched, and as they leave the whole job."""
    config = RunConfig(reconstruct=None, detect=options)
    opened = Opened(scene, Photos(scene), None, mask_kind="", views_left_out=(), config=config)
    known = find_in_photos(opened, cache=None if cache is None else CachedDetections(cache))
    return known.matched[0], shape_leaves(known).masks


def judge(masks: Masks, truth: list[np.ndarray]) -> Figures:
    """Masks and whole leaves against the truth."""
    figures = leaf_metrics(masks.regions, masks.instance_ids, truth)
    return {
        "recall": figures.mask_recall,
        "precision": figures.mask_precision,
        "pair F1": figures.all_pair_f1,
        "MV-PQ": figures.mv_pq,
        "leaves right": figures.num_right,
        "false": figures.num_false,
    }


def count(found: Masks, masks: Masks) -> Figures:
    """What can be said without truth: `found` by the detector, `masks` in the end."""
    ids, views = masks.instance_ids, masks.view_index
    shown = {instance: len(views[ids == instance].unique()) for instance in ids[ids > 0].unique().tolist()}
    many = [instance for instance, number in shown.items() if number >= MANY]
    inside = torch.isin(ids, torch.tensor(many, dtype=torch.int64))
    return {
        "masks found": len(found),
        "masks": len(masks),
        "instances": len(shown),
        f"in {MANY} views": len(many),
        "share of masks there": float(inside.float().mean()) if len(masks) else 0.0,
    }


def judge_basil(folder: Path, draw: Draw, args: argparse.Namespace) -> Figures:
    scene = load_scene(folder)
    sizes = zip(scene.views, scene.cameras.sizes.tolist(), strict=True)
    truth = [read_label_png(folder / "truth" / f"{view.name}.png", *size) for view, size in sizes]
    mirrored = mirror_scene(scene, args.keep / "mirrored" / folder.name)
    flipped = [np.ascontiguousarray(labels[:, ::-1]) for labels in truth]
    rows = [judge(draw(DetectConfig(), scene, folder.name)[1], truth)]
    print("  default", show(rows[0]), flush=True)
    for size in args.sizes:
        for each, labels in ((scene, truth), (mirrored, flipped)):
            rows.append(judge(draw(DetectConfig(image_size=size), each, f"{each.name}-{size}")[1], labels))
            print(f"  {each.name} {size}:", show(rows[-1]), flush=True)
    figures = {f"default: {name}": value for name, value in rows[0].items()}
    for name in rows[0] if args.sizes else ():
        values = [row[name] for row in rows[1:]]
        figures |= {f"mean {name}": float(np.mean(values)), f"spread {name}": float(np.std(values))}
    return figures


def judge_unlabelled(folder: Path, draw: Draw, args: argparse.Namespace) -> Figures:
    scene = load_scene(folder)
    every = 2 if folder.name.startswith("fern") else 1
    views = list(range(0, len(scene.views), every))
    scene = replace(scene, views=tuple(scene.views[view] for view in views), cameras=scene.cameras[views])
    found, masks = draw(DetectConfig(), scene, folder.name)
    figures = count(found, masks)
    if (folder / "silhouettes").is_dir():
        figures |= count_outside(folder / "silhouettes", scene, found=found, masks=masks)
    return figures


def count_outside(folder: Path, scene: Scene, **stages: Masks) -> Figures:
    """Masks of which less than half is on the plant."""
    shown = {
        view: read_rgb(folder / f"{Path(each.name).name}.png")[..., 0] > 127 for view, each in enumerate(scene.views)
    }
    figures = {}
    for name, masks in stages.items():
        sizes = [scene.cameras.sizes[view].tolist() for view in masks.view_index.tolist()]
        crops = [masks.regions.mask(row, *size).numpy() for row, size in enumerate(sizes)]
        on_plant = [shown[view][crop].mean() for view, crop in zip(masks.view_index.tolist(), crops, strict=True)]
        figures[f"beside the plant ({name})"] = float(sum(share < 0.5 for share in on_plant))
    return figures


@torch.no_grad()
def judge_siliques(folder: Path, weights: str, args: argparse.Namespace) -> Figures:
    detector = load_detector(weights, min_score=DetectConfig.min_score)
    photos = sorted((folder / "images").iterdir())[::10]
    total, slender = 0, 0
    for path in photos:
        photo = torch.from_numpy(read_rgb(path)).permute(2, 0, 1).float() / 255
        found, masks = detect_in_photo(detector, photo)
        for score, mask in zip(found["scores"].tolist(), masks, strict=True):
            rows, columns = np.nonzero(mask.numpy() > 0.5)
            if score < DetectConfig.min_score or len(rows) < 3:
                continue
            _, sides, _ = cv2.minAreaRect(np.stack((columns, rows), 1).astype(np.float32))
            total += 1
            is_slender = max(sides) >= SLENDER * max(min(sides), 1)
            slender += bool(is_slender and rows.mean() < ROSETTE * photo.shape[1])
    return {"masks per photo": total / len(photos), "slender ones above the rosette": slender / len(photos)}


def judge_rosettes(folder: Path, weights: str, args: argparse.Namespace) -> Figures:
    samples = list_samples(folder / "images", folder / "labels")
    samples = samples.select([index for index in range(len(samples)) if index % 5 in (1, 3)])
    detector = load_detector(weights)
    truth, found = detect_and_label(detector, samples, range(len(samples)))
    figures = average_precision(truth, found, len(samples))
    dice = count_and_dice(truth, found, len(samples), min_score=DetectConfig.min_score)
    return {
        "mask AP50": float("nan") if figures["mask_AP50"] is None else figures["mask_AP50"],
        "best Dice": dice["sbd"],
        "count off by": dice["absolute_count_difference"],
    }


SCENES: Mapping[str, Callable] = {
    "basil-0729": judge_basil,
    "fern-llff": judge_unlabelled,
    "maize-plant1": judge_unlabelled,
    "arabidopsis-romi": judge_siliques,
    "rosettes-cvppp-a1": judge_rosettes,
}


def draw_found(
    weights: str, args: argparse.Namespace, options: DetectConfig, scene: Scene, name: str
) -> tuple[Masks, Masks]:
    """`find_masks` with some weights; with `--pictures`, what comes out is drawn, four photos of each scene."""
    keep = args.keep / "detections" / f"{Path(weights).parent.name or weights}-{name}"
    masks = find_masks(scene, replace(options, weights=weights), keep)
    if args.pictures is not None and options.image_size is None:
        views = range(0, len(scene.views), max(1, len(scene.views) // 4))
        photos = Photos(scene)
        drawn = [draw_overlay(photos(view), masks[1], view=view) for view in views]
        label = Path(weights).parent.name or weights
        write_png(args.pictures / f"{name}-{label}.png", np.concatenate([each[: len(drawn[0])] for each in drawn], 1))
    return masks


def show(figures: Figures) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in figures.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", nargs="+", default=[DetectConfig.weights])
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES, help="longer sides of photos, for the basil")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    board: dict[str, dict[str, Figures]] = {}
    with tempfile.TemporaryDirectory() as folder:
        args.keep = args.keep or Path(folder)
        for path in (args.keep, args.pictures):
            if path is not None:
                path.mkdir(parents=True, exist_ok=True)
        for name in [name for name in args.scenes if (args.data / name).is_dir()]:
            for weights in args.weights:
                print(f"{name}, {weights}:", flush=True)
                how = partial(draw_found, weights, args) if SCENES[name] in (judge_basil, judge_unlabelled) else weights
                board.setdefault(name, {})[weights] = SCENES[name](args.data / name, how, args)
                print("  " + show(board[name][weights]), flush=True)
                if args.json:
                    args.json.write_text(json.dumps(board, indent=1) + "\n", encoding="utf-8")
    print("\n| scene | " + " | ".join(args.weights) + " |\n|---|" + "---|" * len(args.weights))
    for name, columns in board.items():
        for figure in next(iter(columns.values())):
            cells = [f"{columns[weights].get(figure, float('nan')):.3g}" for weights in columns]
            print(f"| {name}: {figure} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
