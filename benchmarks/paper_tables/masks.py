"""The masks that are matched: true, degraded, or a detector's; and which leaf each of them shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.faults import Faults, degrade_labels
from benchmarks.found_leaves import tied_instances
from benchmarks.paper_tables.cells import Cell
from mvseg.crop import Crop
from mvseg.detection.config import DetectConfig
from mvseg.evaluation.truth import true_instances
from mvseg.formats.photos import load_photos
from mvseg.formats.scene_folder import load_masks
from mvseg.regions import IGNORE_LABEL, Regions, regions_from_label_maps, stack_regions

MIN_PIXELS = 30  # of a detected mask; true and degraded masks have as many


@dataclass(frozen=True, eq=False)
class Masks:
    """The masks of a cell.

    Attributes:
        regions: all D masks; all of them are matched.
        true_ids: (D,) int64, the leaf that each one shows; 0 = none, not scored.
        num_missed: true masks without a detection; 0 for true and degraded masks.
    """

    regions: Regions
    true_ids: Tensor
    num_missed: int = 0


def true_masks(cell: Cell) -> Masks:
    """The visible part of every leaf, in an order that tells nothing."""
    regions = load_masks(cell.scene, cell.folder / "masks")
    return Masks(regions, most_shown(regions, cell.truth))


def degraded_masks(cell: Cell) -> Masks:
    """The masks of a segmenter with the default `Faults`; a mask over two leaves counts as that of the larger part."""
    entropy = [len(cell.truth), *cell.name.encode()]
    seeds = np.random.SeedSequence(entropy).generate_state(len(cell.truth))
    maps = [degrade_labels(ids, Faults(), seed=int(seed)) for ids, seed in zip(cell.truth, seeds, strict=True)]
    regions = regions_from_label_maps(maps)
    return Masks(regions, most_shown(regions, cell.truth))


def detected_masks(cell: Cell, detector: str) -> Masks:
    """The masks that a shipped detector, or one in a .safetensors file, finds in each photo separately."""
    return find_masks(load_photos(cell.scene), cell.truth, detector=detector)


def find_masks(photos: Iterable[Tensor], truth: Sequence[np.ndarray], *, detector: str) -> Masks:
    """The same for photos (3, H, W) float32 in [0, 1] with true label maps (H, W). Each mask shows the leaf whose true
    mask it has its best IoU with, if that is 0.5 or more."""
    from mvseg.detectors.run import detect
    from mvseg.detectors.zoo import load_detector

    model = load_detector(detector)
    rows = list[tuple[int, Crop, int]]()
    with torch.no_grad():
        for view, photo in enumerate(photos):
            detections, pasted = detect(model, photo)
            for score, soft in zip(detections["scores"].tolist(), pasted, strict=True):
                mask = Crop.of(soft > 0.5)
                if score >= DetectConfig.min_score and mask.area >= MIN_PIXELS:
                    rows.append((view, mask, len(rows)))
    regions = stack_regions(rows, len(truth))
    leaf = tied_instances(regions, truth)
    found = set(zip(regions.view_index[leaf > 0].tolist(), leaf[leaf > 0].tolist(), strict=True))
    num_true = sum(len(set(np.unique(labels)) - {0, IGNORE_LABEL}) for labels in truth)
    return Masks(regions, leaf, num_missed=num_true - len(found))


def most_shown(regions: Regions, truth: Sequence[np.ndarray]) -> Tensor:
    """(D,) int64: the leaf that each region shows most of, 0 when it shows none or mostly ignored pixels."""
    shown = true_instances(regions, truth, count_background=False)
    return torch.where(shown == IGNORE_LABEL, 0, shown)
