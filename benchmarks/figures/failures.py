"""Draws docs/failures.jpg, where the matcher fails on the shipped plant: `python benchmarks/figures/failures.py`

The masks get a segmenter's faults. Top: matched in nine views; bottom: in three of them. A region outlined in white has
the id of another leaf than the one that it shows, or none.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.faults import Faults, degrade_labels
from mvseg import Matching, load_masks, load_scene, match_regions
from mvseg.demo import demo_scene
from mvseg.evaluation.truth import shown_instances
from mvseg.formats.photos import read_photo
from mvseg.masks import Masks
from mvseg.regions import regions_from_label_maps
from mvseg.results.overlay import draw_overlay
from mvseg.scene import Scene

DOCS = Path(__file__).parents[2] / "docs"
WHITE = (255, 255, 255)
NUM_SEEDS = 12
NUM_TILES = 3  # views per row


def wrong_regions(matching: Matching, leaf: torch.Tensor) -> torch.Tensor:
    """(D,) bool: unmatched, or in a cluster of which most regions show another leaf than `leaf` (D,)."""
    ids = matching.instance_ids
    wrong = ids < 0
    for instance in ids[~wrong].unique():
        members = ids == instance
        wrong |= members & (leaf != leaf[members].mode().values)
    return wrong


def draw_tile(scene: Scene, masks: Masks, *, view: int, wrong: torch.Tensor) -> np.ndarray:
    """(h, w, 3) RGB: the overlay of a view, with the wrong regions outlined."""
    overlay = draw_overlay(read_photo(scene, view), masks, view=view)
    height, width = overlay.shape[:2]
    for index in ((masks.view_index == view) & wrong).nonzero()[:, 0].tolist():
        mask = masks.regions.mask(index, *scene.cameras.sizes[view].tolist()).numpy().astype(np.uint8)
        mask = np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST))
        borders, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(overlay, borders, -1, WHITE, 3)
    return overlay


def draw_failures(scene: Scene, truth: list[np.ndarray], seed: int) -> tuple[np.ndarray, int]:
    """The views with most failures in a row, and the number of failures in all views."""
    maps = [degrade_labels(labels, Faults(), seed=100 * seed + view) for view, labels in enumerate(truth)]
    regions = regions_from_label_maps(maps)
    matching = match_regions(regions, scene.cameras)
    wrong = wrong_regions(matching, shown_instances(regions, truth, count_background=False))
    failures = torch.bincount(regions.view_index[wrong], minlength=len(truth))
    views = failures.argsort(descending=True, stable=True)[:NUM_TILES].sort().values.tolist()
    tiles = [draw_tile(scene, matching.masks, view=view, wrong=wrong) for view in views]
    return np.concatenate(tiles, 1), int(wrong.sum())


def main() -> None:
    scene = load_scene(demo_scene())
    truth = load_masks(scene, demo_scene() / "truth")
    sizes = scene.cameras.sizes.tolist()
    maps = [truth.label_map(view, truth.labels, size).numpy() for view, size in enumerate(sizes)]
    some = [1, 4, 7]
    three = Scene(
        name=scene.name, views=tuple(scene.views[view] for view in some), cameras=scene.cameras[some], unit=scene.unit
    )
    rows = []
    for views, labels in ((scene, maps), (three, [maps[view] for view in some])):
        drawn = [draw_failures(views, labels, seed) for seed in range(NUM_SEEDS)]
        rows.append(max(drawn, key=lambda row: row[1])[0])
        print(len(labels), "views: failures per seed", [number for _, number in drawn])
    image = cv2.resize(np.concatenate(rows), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(DOCS / "failures.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
