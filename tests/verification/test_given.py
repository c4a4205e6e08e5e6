"""What surfaces say of ids: three known leaves, seen by six cameras, with masks of the wrong ids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from blade_scene import SIZE, as_regions
from known_leaves import flat_leaf
from matched import matched
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.verification.choose import Edited
from three_leaves import CAMERAS, LEAVES, true_maps
from verified import verify_ids


def check(regions: Regions, ids: Tensor, surfaces: dict[int, LeafSurface] = LEAVES) -> Masks:
    return verify_ids(matched(regions, ids).masks, surfaces, cameras=CAMERAS)


def is_moved(before: Tensor, after: Masks) -> Tensor:
    return before != after.instance_ids


@pytest.fixture(scope="module")
def scene() -> tuple[Regions, Tensor]:
    return as_regions(true_maps())


def place_of(regions: Regions, ids: Tensor, view: int, instance: int) -> int:
    return int(((regions.view_index == view) & (ids == instance)).nonzero()[0, 0])


def test_right_ids_stay_as_they_are(scene: tuple[Regions, Tensor]) -> None:
    regions, ids = scene
    checked = check(regions, ids)
    before = matched(regions, ids).masks
    assert torch.equal(checked.instance_ids, ids)
    assert torch.equal(checked.match_scores, before.match_scores)
    assert checked.count_sure_views().tolist() == [6, 6, 6]


def test_two_masks_with_each_others_ids_are_swapped(scene: tuple[Regions, Tensor]) -> None:
    regions, ids = scene
    one, other = (place_of(regions, ids, 2, instance) for instance in (1, 2))
    wrong = ids.clone()
    wrong[one], wrong[other] = 2, 1
    scores = torch.full((len(ids),), 0.9)
    scores[one], scores[other] = 0.1, 0.2
    checked = verify_ids(matched(regions, wrong, scores).masks, LEAVES, cameras=CAMERAS)
    assert torch.equal(checked.instance_ids, ids)
    assert is_moved(wrong, checked).nonzero()[:, 0].tolist() == sorted([one, other])
    is_swapped = is_moved(wrong, checked)
    assert torch.equal(checked.match_scores[~is_swapped], scores[~is_swapped])
    assert checked.match_scores[is_swapped].min() > 0.99  # q


@pytest.mark.parametrize(("num_views", "is_certain"), [(4, True), (5, False)])
def test_few_views_do_not_overrule_a_sure_match(num_views: int, is_certain: bool) -> None:
    regions, leaves = as_regions(true_maps()[:num_views])
    ids = leaves.clone()
    ids[place_of(regions, leaves, 2, 1)], ids[place_of(regions, leaves, 2, 2)] = 2, 1
    checked = verify_ids(matched(regions, ids).masks, LEAVES, cameras=CAMERAS[list(range(num_views))])
    assert torch.equal(checked.instance_ids, ids if is_certain else leaves)


def test_no_mask_shows_the_surface_of_an_instance_that_has_no_masks_left() -> None:
    """The only mask of instance 4 shows leaf 2, drawn too large to be a piece of it; its surface lies over leaf 1."""
    maps = true_maps()
    grown = distance_transform_edt(maps[3] != 2) <= 6
    maps[3] = np.where(grown & (maps[3] == 0), 2, maps[3])
    regions, leaves = as_regions(maps)
    ids = leaves.clone()
    ids[place_of(regions, leaves, 3, 2)] = 4
    over = flat_leaf(length=0.8, half_width=0.35, at=(-0.8, -0.3, 0.42))
    checked = check(regions, ids, LEAVES | {4: over})
    assert torch.equal(checked.instance_ids, leaves)


def test_masks_that_a_detector_found_are_held_as_given_ones_are(scene: tuple[Regions, Tensor]) -> None:
    """Where the views may not choose among its proposals: a small piece of another leaf is no reason to move."""
    regions, ids = scene
    away = {number: flat_leaf(length=0.4, half_width=0.1, at=(3.0, 3.0 + number, 0.0)) for number in (1, 2, 3)}
    detected = replace(matched(regions, ids).masks, origin=torch.full_like(ids, Origin.DETECTED))
    scored = replace(detected, detection_scores=torch.full((len(ids),), 0.6))
    assert torch.equal(verify_ids(scored, away, cameras=CAMERAS).instance_ids, ids)


def test_an_instance_without_a_surface_keeps_its_masks(scene: tuple[Regions, Tensor]) -> None:
    """A line of one pixel, say, with the highest id of all."""
    regions, ids = scene
    surfaces = {**LEAVES, 3: LeafSurface.none(torch.arange(6), "test", "its masks do not tell its shape")}
    checked = check(regions, ids, surfaces)
    assert torch.equal(checked.instance_ids, ids)


def test_a_mask_without_an_id_gets_one_and_what_shows_no_surface_keeps_its_own(scene: tuple[Regions, Tensor]) -> None:
    maps = true_maps()
    maps[1][5:25, 5:25] = 103  # of leaf 3, says the matcher, which has a mask there
    regions, numbers = as_regions(maps)
    ids = numbers % 10
    wrong = ids.clone()
    wrong[place_of(regions, numbers, 4, 2)] = -1
    checked = check(regions, wrong)
    assert torch.equal(checked.instance_ids, ids)


@pytest.mark.parametrize("is_linked", [True, False])
def test_a_mask_that_the_user_keeps_apart_from_a_leaf_does_not_return_to_it(
    is_linked: bool, scene: tuple[Regions, Tensor]
) -> None:
    """ "different": the matcher then matches it to nothing, but its leaf's surface is where it is."""
    regions, ids = scene
    wrong, row = ids.clone(), place_of(regions, ids, 4, 2)
    wrong[row] = -1
    masks = matched(regions, wrong).masks
    both = torch.tensor([row, place_of(regions, ids, 3, 2)])
    edits = replace(masks, is_linked=torch.isin(torch.arange(len(ids)), both) & is_linked)
    edited = Edited(edits, (None,) * len(ids), ids < 0, torch.zeros(0).long(), torch.zeros(0, 2).long())
    checked = verify_ids(masks, LEAVES, cameras=CAMERAS, edited=edited).instance_ids
    expected = wrong if is_linked else ids
    assert torch.equal(checked[:, None] == checked, expected[:, None] == expected)


def test_a_mask_does_not_go_where_another_fits_as_well(scene: tuple[Regions, Tensor]) -> None:
    """Two masks of the same pixels, one of them matched to a leaf far away."""
    regions, ids = scene
    one = place_of(regions, ids, 0, 1)
    twice = regions.select(torch.cat((torch.arange(len(ids)), torch.tensor([one]))))
    doubled = torch.cat((ids, torch.tensor([3])))
    assert not is_moved(doubled, check(twice, doubled)).any()


def test_the_order_of_masks_and_of_ids_does_not_matter(scene: tuple[Regions, Tensor]) -> None:
    regions, ids = scene
    wrong = ids.clone()
    one, other = (place_of(regions, ids, 5, instance) for instance in (1, 2))
    wrong[one], wrong[other] = 2, 1
    expected = check(regions, wrong)
    assert torch.equal(expected.instance_ids, ids)
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(2))
    renamed = torch.tensor([0, 3, 1, 2])  # of the ids
    named_anew = {int(renamed[instance]): surface for instance, surface in LEAVES.items()}
    checked = check(regions.select(order), renamed[wrong[order]], dict(sorted(named_anew.items())))
    assert torch.equal(checked.instance_ids, renamed[expected.instance_ids][order])


def test_without_surfaces_or_masks_nothing_happens(scene: tuple[Regions, Tensor]) -> None:
    regions, ids = scene
    assert torch.equal(check(regions, ids, {}).instance_ids, ids)
    empty, nothing = as_regions([np.zeros((SIZE, SIZE), np.int64)] * 6)
    assert len(check(empty, nothing, {})) == 0
