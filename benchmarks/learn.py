"""What the views teach the detector: `python benchmarks/learn.py SCENE... [--rounds 3]`

For each scene a table: as it is; after one, two, three rounds (each from the labels of the last, whatever E says),
and after one round in which a person has outlined six leaves in two photos each, the largest ones that are not right;
his masks do not count in the figures. With --next, what the weights of each round find on the next plant, as they are.
E, the expected number of right masks, stands beside what the truth says, where
the scene has a folder `truth`. `stays` marks what `mvseg infer --learn 3` would keep: E grows by `GROWTH`.
Weights and detections are kept in --cache.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.choice import true_maps
from benchmarks.drawn_leaves import open_views
from benchmarks.simulated_person import Labels, Look
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.masks import Masks
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.known import Known
from mvseg.pipeline.learn import GROWTH, learn
from mvseg.pipeline.open_scene import open_scene

DRAWN, PHOTOS = 6, 2  # leaves that the person outlines, and in how many photos each
HEAD = ("", "E", "stays", "MV-PQ", "right", "false", "recall", "precision", "leaves", "masks", "CPU s")


def judge(masks: Masks, truth: list[Labels] | None) -> dict[str, str]:
    found = {"leaves": str(masks.num_instances), "masks": str(int((masks.instance_ids > 0).sum()))}
    if truth is None:
        return found
    figures = leaf_metrics(masks.regions, masks.instance_ids, truth)
    return found | {
        "MV-PQ": f"{figures.mv_pq:.3f}",
        "right": f"{figures.num_right} of {figures.num_right + figures.num_missed}",
        "false": str(figures.num_false),
        "recall": f"{figures.mask_recall:.2f}",
        "precision": f"{figures.mask_precision:.2f}",
    }


def outline_some(known: Known, truth: list[Labels]) -> Corrections:
    """Six leaves, each in the two photos that show most of it: the largest that are not right, then the largest."""
    look = Look(shape_leaves(known).masks.to("cpu"), truth, known.scene, ())
    views_of = {leaf: open_views(look.visible[:, leaf]) for leaf in range(1, len(look.size))}
    seen = [leaf for leaf, views in views_of.items() if len(views) >= PHOTOS]
    chosen = sorted(seen, key=lambda leaf: (leaf in look.right, -float(look.size[leaf])))[:DRAWN]
    best = {leaf: sorted(views_of[leaf], key=lambda view: -float((truth[view] == leaf).sum())) for leaf in chosen}
    return Corrections(tuple(look.outline(leaf, view) for leaf in chosen for view in best[leaf][:PHOTOS]))


def show(name: str, known: Known, truth: list[Labels] | None, *, stays: str, begun: float) -> None:
    row: dict[str, Any] = {"": name, "E": f"{known.expected_right:.0f}", "stays": stays}
    row |= judge(shape_leaves(known).masks.to("cpu"), truth) | {"CPU s": f"{time.process_time() - begun:.0f}"}
    print("| " + " | ".join(str(row.get(column, "")) for column in HEAD) + " |", flush=True)


def see_next(folder: Path, weights: bytes | None, name: str, *, cache: CachedDetections) -> None:
    """A row of another plant, seen with learned weights; None: with the shipped ones."""
    with NamedTemporaryFile(suffix=".safetensors") as file:
        file.write(weights or b"")
        file.flush()
        detect = DetectConfig() if weights is None else DetectConfig(weights=file.name)
        begun = time.process_time()
        opened = open_scene(folder, None, RunConfig(reconstruct=None, learn="off", detect=detect))
        known = find_in_photos(opened, cache=cache)
    truth = true_maps(folder, opened.scene) if (folder / "truth").is_dir() else None
    show(name, known, truth, stays="", begun=begun)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--person", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--image_size", type=int, default=None)
    parser.add_argument("--next", type=Path, help="folder of another plant of the same species")
    parser.add_argument("--cache", type=Path, default=Path("results/learn"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    np.set_printoptions(precision=3)
    warnings.simplefilter("ignore", InputWarning)
    for folder in args.scenes:
        config = RunConfig(reconstruct=None, learn="off", detect=DetectConfig(image_size=args.image_size))
        opened, begun = open_scene(folder, None, config), time.process_time()
        cache = CachedDetections(args.cache / folder.resolve().name)
        first = known = find_in_photos(opened, cache=cache)
        truth = true_maps(folder, opened.scene) if (folder / "truth").is_dir() else None
        print(f"\n**{folder.resolve().name}**: {len(opened.scene.views)} photos, seen at {known.looks[0].longest} px\n")
        print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
        show("as it is", known, truth, stays="", begun=begun)
        if args.next is not None:
            see_next(args.next, None, "the next plant", cache=cache)
        stays = True
        for number in range(1, args.rounds + 1):
            begun, before = time.process_time(), known
            known = learn(known, cache=cache, rounds=1)
            stays = stays and known.expected_right >= GROWTH * before.expected_right
            show(f"round {number}", known, truth, stays="yes" if stays else "no", begun=begun)
            if args.next is not None:
                see_next(args.next, known.learned.weights, f"the next plant, weights of round {number}", cache=cache)
        if args.person and truth is not None:
            begun, corrections = time.process_time(), outline_some(first, truth)
            known = learn(first, cache=cache, corrections=corrections, rounds=1)
            show(f"{DRAWN} leaves of a person, learned", known, truth, stays="", begun=begun)
            begun = time.process_time()
            corrected = apply_edits(known, corrections)
            show("the same, and his masks", corrected, truth, stays="", begun=begun)


if __name__ == "__main__":
    main()
