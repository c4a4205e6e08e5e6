"""Masks outside their own surface are matched once more: three known leaves, seen by six cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from blade_scene import SIZE, as_regions
from matched import matched
from mvseg.masks import Masks, MergedMask
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.verification.checked_ids import check_ids
from mvseg.verification.evidence import Shown
from mvseg.verification.rematched_masks import find_misfits, rematch_misfits
from three_leaves import CAMERAS, LEAVES, true_maps

NOBODY = torch.zeros(0, dtype=torch.bool)


def fitted_badly(instance: int, views: list[int]) -> LeafSurface:
    """The leaf, which its fit could not bend to the masks of these views."""
    iou = LEAVES[instance].iou.clone()
    iou[views] = 0.3
    return replace(LEAVES[instance], iou=iou)


SURFACES = {1: fitted_badly(1, [0, 1]), 3: fitted_badly(3, [2, 3])}


@pytest.fixture(scope="module")
def scattered() -> tuple[Regions, Tensor, Tensor]:
    """Regions, their leaves, and ids: of leaf 2, two masks went to leaf 1 and two to leaf 3, which have none there."""
    maps = true_maps()
    for view, labels in enumerate(maps):
        labels[labels == (1, 1, 3, 3, 2, 2)[view]] = 0
    regions, leaves = as_regions(maps)
    ids = torch.where(leaves == 2, torch.where(regions.view_index < 2, 1, 3), leaves)
    return regions, leaves, ids


def unsure(regions: Regions, ids: Tensor, rows: Tensor) -> Masks:
    """The masks of these rows (D,) bool are matched by half a chance."""
    return matched(regions, ids, torch.where(rows, 0.5, 0.95)).masks


def rematch(masks: Masks, *, held: Tensor = NOBODY, config: MatchConfig = MatchConfig()) -> Masks:
    free = ~held if len(held) else torch.ones(len(masks), dtype=torch.bool)
    shown = Shown.of(masks.regions, SURFACES, CAMERAS)
    return rematch_misfits(masks, SURFACES, shown=shown, cameras=CAMERAS, free=free, config=config)


def misfits(masks: Masks, surfaces: dict[int, LeafSurface]) -> Tensor:
    return find_misfits(masks, surfaces, Shown.of(masks.regions, surfaces, CAMERAS))


def test_the_masks_of_a_scattered_leaf_find_each_other(scattered: tuple[Regions, Tensor, Tensor]) -> None:
    regions, leaves, ids = scattered
    is_second = leaves == 2
    rows = is_second.nonzero()[:, 0].tolist()
    merged = [MergedMask(region=rows[0], own=1, other=3, part=regions.crop(rows[0]))]
    masks = unsure(regions, ids, is_second).with_merged(merged)
    assert torch.equal(misfits(masks, SURFACES), is_second)
    found = rematch(masks)
    assert torch.equal(found.instance_ids, torch.where(is_second, 4, ids))
    assert torch.equal(found.match_scores[~is_second], masks.match_scores[~is_second])
    assert found.match_scores[is_second].min() > 0.5
    assert found.merged == ()
    checked = check_ids(masks, SURFACES, cameras=CAMERAS)
    assert torch.equal(checked.instance_ids, found.instance_ids)
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(3))
    assert torch.equal(rematch(masks.select(order)).instance_ids, found.instance_ids[order])


@pytest.mark.parametrize("reason", ["sure", "fits", "held", "another method", "no surface"])
def test_other_masks_stay(scattered: tuple[Regions, Tensor, Tensor], reason: str) -> None:
    regions, leaves, ids = scattered
    is_second = leaves == 2
    masks = unsure(regions, ids, is_second & (reason != "sure"))
    surfaces = {"fits": LEAVES, "no surface": {1: LeafSurface.none(torch.arange(6), "a test")}}.get(reason, SURFACES)
    config = MatchConfig(num_instances=3) if reason == "another method" else MatchConfig()
    free, shown = ~is_second | (reason != "held"), Shown.of(regions, surfaces, CAMERAS)
    found = rematch_misfits(masks, surfaces, shown=shown, cameras=CAMERAS, free=free, config=config)
    assert found is masks


def test_a_mask_joins_the_leaf_that_it_shows_or_stays() -> None:
    """In view 0, leaf 2 has the id of leaf 1, which has no mask there; in view 3 a mere spot has the id of leaf 3."""
    maps = true_maps()
    maps[0][maps[0] == 1] = 0
    maps[3][maps[3] == 3] = 0
    maps[3][5:25, 5:25] = 13
    regions, leaves = as_regions(maps)
    is_wrong = (leaves == 13) | ((leaves == 2) & (regions.view_index == 0))
    ids = torch.where(leaves == 13, 3, torch.where(is_wrong, 1, leaves))
    masks = unsure(regions, ids, is_wrong)
    assert torch.equal(misfits(masks, SURFACES), is_wrong)
    found = rematch(masks)
    assert torch.equal(found.instance_ids, torch.where(leaves == 13, 3, leaves))
    assert found.match_scores[leaves == 13].tolist() == [0.5]


@pytest.mark.parametrize("shift", [0, 12, 25, 60])
def test_what_lies_inside_is_counted_as_on_whole_frames(shift: int) -> None:
    """Masks of leaf 1, unhidden, that are moved sideways."""
    maps = [part.numpy().astype(np.int64) for part in LEAVES[1].project(CAMERAS)]
    regions, ids = as_regions([np.roll(labels, shift, axis=1) for labels in maps])
    masks = unsure(regions, ids, ids > 0)
    surfaces = {1: fitted_badly(1, [*range(6)])}
    views = regions.view_index.tolist()
    shares = []
    for row, view in enumerate(views):
        mask = regions.mask(row, SIZE, SIZE).numpy()
        shares.append((mask & (maps[view] == 1)).sum() / mask.sum())
    assert misfits(masks, surfaces).tolist() == [share < 0.4 for share in shares]
