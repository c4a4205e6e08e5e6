"""Masks on their own: how many, how large, and where."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mvseg.checks.numbers import IMAGES
from mvseg.findings.finding import Finding, Rule, Values, list_findings
from mvseg.formats.masks.view_regions import mask_faults
from mvseg.regions import Regions
from mvseg.scene import Cameras


def mask_findings(
    regions: Regions, cameras: Cameras, names: tuple[str, ...], *, is_detected: bool = False
) -> list[Finding]:
    """The findings about the D masks of V views. Those that a detector found are cut, if anything."""
    rules = _size_rules(regions, cameras) if len(regions) else []
    if is_detected:
        return list_findings(rules, names)
    if len(regions):
        rules = [*_count_rules(regions.num_per_view.numpy()), *rules, _small_component_rule(regions, cameras)]
    return list_findings([*mask_faults(regions, cameras.sizes.tolist()), *rules], names)


def _count_rules(counts: NDArray[np.int64]) -> list[Rule]:
    empty = np.flatnonzero(counts == 0).tolist()
    if len(counts) - len(empty) < 2:  # an error, see `mask_faults`
        return []
    usual = float(np.median(counts[counts > 0]))
    few = np.flatnonzero((counts > 0) & (counts < IMAGES.few * usual)).tolist()
    values = {"count": int(counts[counts > 0].min()), "usual": usual}
    return [("views_without_masks", "warning", empty, {}), ("few_masks", "warning", few, values)]


def _size_rules(regions: Regions, cameras: Cameras) -> list[Rule]:
    areas = regions.areas.numpy()
    size: Values = {"px": IMAGES.tiny_px, "median": float(np.median(areas))}
    is_tiny, is_cut = areas < IMAGES.tiny_px, touches_border(regions, cameras).numpy()
    return [
        (code, "warning", None, {"count": int(is_faulty.sum()), "total": len(areas), **more})
        for code, is_faulty, more in (("tiny_masks", is_tiny, size), ("cut_masks", is_cut, {}))
        if is_faulty.mean() > IMAGES.many
    ]


def _small_component_rule(regions: Regions, cameras: Cameras) -> Rule:
    longest = cameras.sizes.amax(1).tolist()
    views: set[int] = set()
    for index in range(len(regions)):
        view, crop = int(regions.view_index[index]), regions.crop(index).numpy()
        kept = without_small_components(crop).astype(bool)
        reach = max(crop.shape[axis] - np.ptp(np.flatnonzero(kept.any(1 - axis))) - 1 for axis in (0, 1))
        if reach > IMAGES.beyond * longest[view]:
            views.add(view)
    return "stray_pixels", "warning", sorted(views), {}


def touches_border(regions: Regions, cameras: Cameras) -> Tensor:
    """(D,) bool, whether a region reaches the border of its photo, where it may be cut."""
    return ((regions.boxes[:, :2] <= 0) | (regions.boxes[:, 2:] >= cameras.sizes[regions.view_index])).any(1)


def without_small_components(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A mask (H, W) without the components of less than 0.2 % of its pixels: they would be its ends."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    is_kept = stats[:, cv2.CC_STAT_AREA] >= IMAGES.small_component * mask.sum()
    is_kept[0] = False
    return is_kept[pieces].astype(np.uint8) if is_kept.any() else mask.astype(np.uint8)
