"""Makes docs/failures.jpg: where the matcher goes wrong on the shipped plant. `python docs/failures_picture.py`

The masks get a segmenter's faults. Top: nine views; bottom: three of them. A region outlined in white has the id of
another leaf than the one it shows most of, or none.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from mvseg import load_masks, load_scene, match_regions
from mvseg.demo import demo_scene
from mvseg.formats.photos import read_photo
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.results.overlay import draw_overlay
from mvseg.scene import Scene
from mvseg.simulation.faults import Faults, degrade_labels

DOCS = Path(__file__).parent
WHITE = (255, 255, 255)


def most_shown(regions: Regions, truth: list[np.ndarray]) -> torch.Tensor:
    """(D,) the leaf that each region shows most of."""
    height, width = truth[0].shape
    shown = []
    for n, view in enumerate(regions.view_index.tolist()):
        counts = np.bincount(truth[view][regions.mask(n, width, height).numpy()], minlength=2)
        shown.append(int(counts[1:].argmax()) + 1)
    return torch.tensor(shown)


def draw_failures(scene: Scene, truth: list[np.ndarray], seed: int, shown: int) -> tuple[np.ndarray, int]:
    """The `shown` views with most failures in a row, and the number of all failures."""
    maps = [degrade_labels(labels, Faults(), seed=100 * seed + view) for view, labels in enumerate(truth)]
    regions = regions_from_label_maps(maps)
    matching, leaf = match_regions(regions, scene.cameras), most_shown(regions, truth)
    ids = matching.instance_ids
    main = torch.stack([leaf[ids == k].mode().values for k in range(1, matching.num_instances + 1)])
    wrong = (ids < 0) | (main[ids.clamp(min=1) - 1] != leaf)
    failures = torch.bincount(regions.view_index[wrong], minlength=len(truth))
    tiles = []
    for view in failures.argsort(descending=True, stable=True)[:shown].sort().values.tolist():
        overlay = draw_overlay(read_photo(scene, view), regions, matching, view=view)
        height, width = overlay.shape[:2]
        for n in ((regions.view_index == view) & wrong).nonzero()[:, 0].tolist():
            mask = regions.mask(n, *scene.cameras.sizes[view].tolist()).numpy().astype(np.uint8)
            mask = np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST))
            borders, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(overlay, borders, -1, WHITE, 3)
        tiles.append(overlay)
    return np.concatenate(tiles, 1), int(wrong.sum())


def main() -> None:
    scene = load_scene(demo_scene())
    truth = load_masks(scene, demo_scene() / "truth")
    maps = [
        truth.label_map(view, truth.labels, size).numpy() for view, size in enumerate(scene.cameras.sizes.tolist())
    ]
    some = [1, 4, 7]
    three = Scene(scene.name, tuple(scene.views[view] for view in some), scene.cameras[some], scene.unit)
    rows = []
    for views, labels in ((scene, maps), (three, [maps[view] for view in some])):
        found = [draw_failures(views, labels, seed, 3) for seed in range(12)]
        rows.append(max(found, key=lambda one: one[1])[0])
        print(len(labels), "views: failures per seed", [number for _, number in found])
    image = cv2.resize(np.concatenate(rows), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(DOCS / "failures.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
