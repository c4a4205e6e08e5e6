"""Masks that do not show their own leaf are matched once more: three known leaves, seen by six cameras."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from blade_scene import as_regions
from matched import matched
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.regions import Regions
from three_leaves import CAMERAS, LEAVES, true_maps
from verified import verify_ids

SURFACES = {1: LEAVES[1], 3: LEAVES[3]}


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


def test_the_masks_of_a_scattered_leaf_find_each_other(scattered: tuple[Regions, Tensor, Tensor]) -> None:
    regions, leaves, ids = scattered
    is_second = leaves == 2
    masks = unsure(regions, ids, is_second)
    found = verify_ids(masks, SURFACES, cameras=CAMERAS)
    expected = torch.where(is_second, 2, ids)
    assert torch.equal(found.instance_ids[:, None] == found.instance_ids, expected[:, None] == expected)
    assert torch.equal(found.match_scores[~is_second], masks.match_scores[~is_second])
    assert found.match_scores[is_second].min() > 0.5
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(3))
    again = verify_ids(masks.select(order), SURFACES, cameras=CAMERAS)
    assert torch.equal(again.instance_ids, found.instance_ids[order])


def test_another_method_is_final(scattered: tuple[Regions, Tensor, Tensor]) -> None:
    regions, leaves, ids = scattered
    masks = unsure(regions, ids, leaves == 2)
    found = verify_ids(masks, SURFACES, cameras=CAMERAS, config=MatchConfig(num_instances=3))
    assert torch.equal(found.instance_ids[:, None] == found.instance_ids, ids[:, None] == ids)


def test_a_mask_joins_the_leaf_that_it_shows_or_stays() -> None:
    """In view 0, leaf 2 has the id of leaf 1, which has no mask there; in view 3 a mere spot has the id of leaf 3."""
    maps = true_maps()
    maps[0][maps[0] == 1] = 0
    maps[3][maps[3] == 3] = 0
    maps[3][5:25, 5:25] = 13
    regions, leaves = as_regions(maps)
    is_wrong = (leaves == 13) | ((leaves == 2) & (regions.view_index == 0))
    ids = torch.where(leaves == 13, 3, torch.where(is_wrong, 1, leaves))
    found = verify_ids(unsure(regions, ids, is_wrong), LEAVES, cameras=CAMERAS)
    assert torch.equal(found.instance_ids, torch.where(leaves == 13, 3, leaves))
    assert found.match_scores[leaves == 13].tolist() == [0.5]
