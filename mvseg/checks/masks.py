"""Masks on their own: how many, how large, and where."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mvseg.checks.finding import Finding, Rule, list_findings
from mvseg.checks.numbers import IMAGES
from mvseg.formats.masks.faults import mask_faults
from mvseg.regions import Regions
from mvseg.scene import Cameras


def mask_findings(regions: Regions, cameras: Cameras, names: tuple[str, ...]) -> list[Finding]:
    """The findings about the D masks of V views."""
    rules: list[Rule] = [("error", *fault) for fault in mask_faults(regions, cameras.sizes.tolist())]
    if len(regions):
        rules += [*_count_rules(regions.num_per_view.numpy()), *_size_rules(regions, cameras)]
        rules.append(_small_component_rule(regions, cameras))
    return list_findings("masks", rules, names)


def _count_rules(counts: NDArray[np.int64]) -> list[Rule]:
    empty = np.flatnonzero(counts == 0).tolist()
    if len(counts) - len(empty) < 2:  # an error, see `mask_faults`
        return []
    usual = float(np.median(counts[counts > 0]))
    few = np.flatnonzero((counts > 0) & (counts < IMAGES.few * usual)).tolist()
    facts = f"there are {counts[counts > 0].min()} masks in {{}} where {usual:.0f} are usual"
    return [
        ("warning", empty, "there are no masks in {}: is the plant hidden there, or a file missing?"),
        ("warning", few, f"{facts}: are some missing?"),
    ]


def _size_rules(regions: Regions, cameras: Cameras) -> list[Rule]:
    rules: list[Rule] = []
    areas = regions.areas.numpy()
    tiny = areas < IMAGES.tiny_px
    if tiny.mean() > IMAGES.many:
        sizes = f"fewer than {IMAGES.tiny_px} pixels (median {np.median(areas):.0f})"
        what = f"{tiny.sum()} of {len(regions)} masks have {sizes}: remove small components, or segment larger photos"
        rules.append(("warning", None, what))
    if what := describe_cut(regions, cameras):
        rules.append(("warning", None, what))
    return rules


def describe_cut(regions: Regions, cameras: Cameras) -> str:
    """The sentence about D masks that the borders of V photos cut, where they are many; "" elsewhere."""
    cut = touches_border(regions, cameras)
    if not len(regions) or float(cut.float().mean()) <= IMAGES.many:
        return ""
    what = f"{int(cut.sum())} of {len(regions)} masks touch the border of their photo, and cut leaves come out small"
    return f"{what}: step back, or add photos"


def _small_component_rule(regions: Regions, cameras: Cameras) -> Rule:
    """Masks with stray pixels, which make the search volume for the leaf's shape much too large."""
    longest = cameras.sizes.amax(1).tolist()
    views: set[int] = set()
    for index in range(len(regions)):
        view, crop = int(regions.view_index[index]), regions.crop(index).numpy()
        kept = without_small_components(crop).astype(bool)
        reach = max(crop.shape[axis] - np.ptp(np.flatnonzero(kept.any(1 - axis))) - 1 for axis in (0, 1))
        if reach > IMAGES.beyond * longest[view]:
            views.add(view)
    return "warning", sorted(views), "masks of {} have stray pixels far from the rest of them: remove small components"


def touches_border(regions: Regions, cameras: Cameras) -> Tensor:
    """(D,) bool, whether a region reaches the border of its photo, where it may be cut."""
    return ((regions.boxes[:, :2] <= 0) | (regions.boxes[:, 2:] >= cameras.sizes[regions.view_index])).any(1)


def without_small_components(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A mask (H, W) without the components of less than 0.2 % of its pixels: they would be its ends."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    is_kept = stats[:, cv2.CC_STAT_AREA] >= IMAGES.small_component * mask.sum()
    is_kept[0] = False
    return is_kept[pieces].astype(np.uint8) if is_kept.any() else mask.astype(np.uint8)
