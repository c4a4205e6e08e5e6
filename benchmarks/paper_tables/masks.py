"""The masks that are matched: true, degraded, or a detector's; and which leaf each of them shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper_tables.cells import Cell
from mvseg.config import DetectConfig
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_masks
from mvseg.regions import IGNORE_LABEL, Regions, regions_from_label_maps, stack_regions
from mvseg.simulation.faults import Faults, degrade_labels

MIN_PIXELS = 30  # of a detected mask; true and degraded masks have as many
MIN_IOU = 0.5  # with a true mask, for a detection to count as that leaf


@dataclass(frozen=True, eq=False)
class Masks:
    """The masks of a cell.

    Attributes:
        regions: all D masks; all of them are matched.
        true_ids: (D,) int64, the leaf that each one shows; 0 = none, not scored.
        num_missed: true masks that no detection was tied to; 0 for true and degraded masks.
    """

    regions: Regions
    true_ids: Tensor
    num_missed: int = 0


def true_masks(cell: Cell) -> Masks:
    """The visible part of every leaf, in an order that says nothing."""
    regions = load_masks(cell.scene, cell.folder / "masks")
    return Masks(regions, most_shown(regions, cell.truth))


def degraded_masks(cell: Cell) -> Masks:
    """What a segmenter with the faults of `Faults()` makes of the true masks; one over two leaves is the larger's."""
    size = [len(cell.truth), *cell.name.encode()]
    seeds = np.random.SeedSequence(size).generate_state(len(cell.truth))
    maps = [degrade_labels(ids, Faults(), seed=int(seed)) for ids, seed in zip(cell.truth, seeds, strict=True)]
    regions = regions_from_label_maps(maps)
    return Masks(regions, most_shown(regions, cell.truth))


def detected_masks(cell: Cell, detector: str) -> Masks:
    """What a shipped detector, or one in a .safetensors file, finds in each photo on its own."""
    from mvseg.detectors.zoo import load_detector
    from mvseg.training.average_precision import detect

    model = load_detector(detector)
    view_index, boxes, crops = [], [], []
    with torch.no_grad():
        for view, photo in enumerate(load_photos(cell.scene)):
            found, pasted = detect(model, photo)
            for score, soft in zip(found["scores"].tolist(), pasted, strict=True):
                mask = soft > 0.5
                if score < DetectConfig.min_score or int(mask.sum()) < MIN_PIXELS:
                    continue
                rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
                x1, y1, x2, y2 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
                view_index.append(view)
                boxes.append((x1, y1, x2, y2))
                crops.append(mask[y1:y2, x1:x2].flatten())
    regions = stack_regions(view_index, boxes, crops, list(range(len(crops))), len(cell.truth))
    return tie_detections(regions, cell.truth)


def most_shown(regions: Regions, truth: tuple[np.ndarray, ...]) -> Tensor:
    """(D,) int64: the leaf that each region shows most of, 0 when it shows none.

    The background that an outgrown mask shows does not count. Regions that mostly show ignored pixels get 0.
    """
    ids = []
    for index, (view, x1, y1, x2, y2) in enumerate(places(regions)):
        shown = np.bincount(truth[view][y1:y2, x1:x2][regions.crop(index).numpy()], minlength=2)
        best = int(shown[1:].argmax()) + 1
        ids.append(best if shown[best] and best != IGNORE_LABEL else 0)
    return torch.tensor(ids, dtype=torch.int64)


def tie_detections(regions: Regions, truth: tuple[np.ndarray, ...]) -> Masks:
    """Tie each detection to the leaf in whose true mask it has its best IoU, if that is 0.5 or more."""
    ids, found = [], set()
    sizes = [np.bincount(labels.ravel(), minlength=2) for labels in truth]
    for index, (view, x1, y1, x2, y2) in enumerate(places(regions)):
        mask = regions.crop(index).numpy()
        both = np.bincount(truth[view][y1:y2, x1:x2][mask], minlength=len(sizes[view]))
        iou = both / np.maximum(sizes[view] + mask.sum() - both, 1)
        iou[[0, *range(IGNORE_LABEL, len(iou))]] = 0
        best = int(iou.argmax())
        ids.append(best if iou[best] >= MIN_IOU else 0)
        found.add((view, ids[-1]))
    num_true = sum(int((size[1:IGNORE_LABEL] > 0).sum()) for size in sizes)
    num_found = sum(leaf > 0 for _, leaf in found)
    return Masks(regions, torch.tensor(ids, dtype=torch.int64), num_true - num_found)


def places(regions: Regions) -> list[list[int]]:
    """D lists: the view and the box (x1, y1, x2, y2) of each region."""
    return torch.cat((regions.view_index[:, None], regions.boxes), 1).tolist()
