"""Masks that lack the tip of their leaf get it where most of its masks do; others stay."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from blade_scene import SIZE, as_regions
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.missing_parts import find_missing_parts
from mvseg.verification.numbers import SNAP
from mvseg.verification.snap_edges import snap_masks
from three_leaves import CAMERAS, LEAVES, true_maps

TRUE = true_maps()


def paint(view: int, *, tip: int | None = None) -> np.ndarray:
    """A photo: green leaves on grey ground; `tip`: brightness of the tip of the first leaf, grey as the ground."""
    rng = np.random.default_rng(view)
    photo = np.full((SIZE, SIZE, 3), (110.0, 100.0, 95.0))
    for leaf in LEAVES:
        photo[TRUE[view] == leaf] = np.array((60.0, 140.0, 40.0)) * (0.7 + 0.15 * leaf)
    if tip is not None:
        photo[is_tip(view)] = tip
    return (photo + rng.normal(0, 4, photo.shape)).clip(0, 255).astype(np.uint8)


def is_tip(view: int) -> np.ndarray:
    """(H, W) bool: the last quarter of the first leaf, by its distance from the middle of its base, in the photo."""
    shown = TRUE[view] == 1
    base = CAMERAS[[view]].project(LEAVES[1].points()[0].mean(0, keepdim=True))[0][0, 0].numpy()
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    away = np.hypot(u - base[0], v - base[1])
    return shown & (away > np.quantile(away[shown], 0.75))


def cut_tips(views: tuple[int, ...]) -> Masks:
    """True masks without the tips of the first leaf in these views."""
    labels = [np.where(is_tip(view) & (view in views), 0, each) for view, each in enumerate(TRUE)]
    regions, _ = as_regions(labels)
    return Masks.of(regions, regions.labels, torch.ones(len(regions)), origin=Origin.DETECTED)


def ious(masks: Masks) -> dict[int, float]:
    """{view: IoU of the mask of the first leaf with the true one}."""
    shown = {}
    for row in (masks.instance_ids == 1).nonzero()[:, 0].tolist():
        view = int(masks.view_index[row])
        mask = masks.regions.mask(row, SIZE, SIZE).numpy()
        shown[view] = float((mask & (TRUE[view] == 1)).sum() / (mask | (TRUE[view] == 1)).sum())
    return shown


def test_tips_that_most_masks_lack_are_found_and_taken() -> None:
    masks = cut_tips((0, 1, 2, 3))
    missing = find_missing_parts(masks, LEAVES, paint, cameras=CAMERAS)
    lacking = [row for row, part in enumerate(missing) if part is not None and part.area > 20]
    assert masks.instance_ids[lacking].tolist() == [1] * 4
    assert masks.view_index[lacking].tolist() == [0, 1, 2, 3]
    tables = masks, snap_masks(masks, paint), snap_masks(masks, paint, missing=missing)
    before, bare, after = map(ious, tables)
    for view in (0, 1, 2, 3):
        assert max(before[view], bare[view]) < 0.9
        assert after[view] > 0.95
    missing = find_missing_parts(cut_tips((0, 1)), LEAVES, paint, cameras=CAMERAS)
    assert missing == [None] * len(missing)


def test_what_has_no_color_of_a_leaf_or_lies_in_another_mask_is_not_missing() -> None:
    masks = cut_tips((0, 1, 2, 3))
    is_grey = find_missing_parts(masks, LEAVES, lambda view: paint(view, tip=100), cameras=CAMERAS)
    assert all(part is None or part.area < 20 for part in is_grey)
    tips = [np.where(is_tip(view), 4, 0) for view in range(len(TRUE))]
    regions, _ = as_regions(tips)
    others = Masks.of(regions, regions.labels, torch.ones(len(regions)), origin=Origin.DETECTED)
    both = Masks.concatenate((masks, others))
    missing = find_missing_parts(both, LEAVES, paint, cameras=CAMERAS)
    assert missing == [None] * len(both)


@pytest.mark.parametrize("surfaces", [{}, {2: LEAVES[2]}])
def test_leaves_without_a_surface_lack_nothing(surfaces: dict[int, LeafSurface]) -> None:
    masks = cut_tips((0, 1, 2, 3))
    missing = find_missing_parts(masks, surfaces, paint, cameras=CAMERAS)
    assert missing == [None] * len(masks)
    empty = masks.select(torch.arange(0))
    assert find_missing_parts(empty, LEAVES, paint, cameras=CAMERAS) == []
    assert 0 < SNAP.lacks < 0.25
