"""What the other views say of masks: two known leaves over another, seen by six cameras, and masks with faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from blade_scene import SIZE, as_regions
from mvseg.errors import InputWarning
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.verification.checked_ids import move_masks
from mvseg.verification.other_views import median_parallax, revise_masks, verify_masks
from mvseg.verification.visible_leaves import visible_leaves
from three_leaves import CAMERAS, LEAVES, true_maps

GREEN, BROWN = (70, 150, 50), (120, 90, 60)
TRUE = true_maps()


def num_masks(maps: list[np.ndarray]) -> int:
    return sum(len(np.unique(labels)) - 1 for labels in maps)


def photo(view: int) -> np.ndarray:
    """Green where a leaf is, brown elsewhere."""
    return np.array([BROWN, GREEN], np.uint8)[(TRUE[view] > 0).astype(int)]


def detected(regions: Regions, ids: torch.Tensor, scores: torch.Tensor | None = None) -> Masks:
    return Masks.of(regions, ids, torch.where(ids > 0, 0.9, 0.0), detection_scores=scores, origin=Origin.DETECTED)


def revise(maps: list[np.ndarray], **changes: object) -> Masks:
    regions, numbers = as_regions(maps)
    ids = torch.where(numbers > 100, -1, numbers % 10)  # 11 is a second piece of leaf 1
    given = {"surfaces": LEAVES, "photos": photo, **changes}
    return revise_masks(detected(regions, ids), cameras=CAMERAS, **given)  # type: ignore[arg-type]


def label_maps(revised: Masks) -> list[np.ndarray]:
    ids = revised.instance_ids
    return [revised.regions.label_map(view, ids, (SIZE, SIZE)).numpy() for view in range(len(CAMERAS))]


def is_new(revised: Masks) -> torch.Tensor:
    return revised.origin == Origin.OTHER_VIEWS


def test_right_masks_stay_as_they_are() -> None:
    revised = revise(TRUE)
    assert all(np.array_equal(*pair) for pair in zip(label_maps(revised), TRUE, strict=True))
    assert len(revised) == num_masks(TRUE)
    assert not is_new(revised).any()
    assert revised.count_sure_views().tolist() == [6, 6, 6]


def test_a_missed_leaf_is_shown_by_the_others() -> None:
    maps = [labels.copy() for labels in TRUE]
    maps[2][maps[2] == 1] = 0
    revised = revise(maps)
    shown = label_maps(revised)
    assert all(np.array_equal(*pair) for pair in zip(shown, TRUE, strict=True))
    (new,) = is_new(revised).nonzero()[:, 0].tolist()
    assert (int(revised.regions.view_index[new]), int(revised.instance_ids[new])) == (2, 1)
    assert float(revised.match_scores[new]) == pytest.approx(0.9)
    assert len(revised) == num_masks(TRUE)


def test_pieces_of_a_leaf_are_joined_and_a_piece_alone_is_completed() -> None:
    maps = [labels.copy() for labels in TRUE]
    left = np.indices((SIZE, SIZE))[1] < np.median(np.nonzero(TRUE[0] == 1)[1])
    maps[0][(TRUE[0] == 1) & left] = 11
    columns = np.nonzero(TRUE[3] == 2)[1]
    rest = np.indices((SIZE, SIZE))[1] > np.quantile(columns, 0.3)
    maps[3][(TRUE[3] == 2) & rest] = 0
    revised = revise(maps)
    assert all(np.array_equal(*pair) for pair in zip(label_maps(revised), TRUE, strict=True))
    assert int(is_new(revised).sum()) == 1  # the piece alone
    assert len(revised) == num_masks(maps) - 1  # of two pieces one was made


def test_false_leaves_go() -> None:
    maps = [labels.copy() for labels in TRUE]
    maps[1][5:25, 5:25] = 101  # matched to nothing
    maps[4][TRUE[4] == 3] = 0
    maps[4][5:25, 5:25] = 3  # the id of leaf 3 at a wrong place
    revised = revise(maps)
    assert all(np.array_equal(*pair) for pair in zip(label_maps(revised), TRUE, strict=True))
    assert int((~is_new(revised)).sum()) == num_masks(maps) - 2


def test_what_the_photo_cannot_show_is_not_added() -> None:
    maps = [labels.copy() for labels in TRUE]
    maps[2][maps[2] == 1] = 0

    def with_pot(view: int) -> np.ndarray:
        painted = photo(view)
        painted[TRUE[2] == 1] = BROWN if view == 2 else painted[TRUE[2] == 1]
        return painted

    revised = revise(maps, photos=with_pot)
    assert not (label_maps(revised)[2] == 1).any()
    assert not is_new(revised).any()


def test_leaves_without_a_credible_surface_go_and_ids_close_up() -> None:
    doubtful = LEAVES | {1: replace(LEAVES[1], iou=torch.full((6,), 0.5, dtype=torch.float64))}
    revised = revise(TRUE, surfaces=doubtful)
    assert revised.instance_ids.unique().tolist() == [2, 3]
    assert revised.close_gaps().instance_ids.unique().tolist() == [1, 2]
    assert revised.renumber(LEAVES) == {1: LEAVES[2], 2: LEAVES[3]}


@pytest.mark.parametrize(("num_found", "left"), [(2, [1, 2, 3]), (1, [1, 2])])
def test_what_is_found_in_too_few_of_the_views_that_show_it_goes(num_found: int, left: list[int]) -> None:
    maps = [labels.copy() for labels in TRUE]
    for labels in maps[num_found:]:
        labels[labels == 3] = 0
    assert revise(maps).instance_ids.unique().tolist() == left  # leaf 3 is seen by all six


def test_views_that_show_no_leaf_where_it_lies_open_count_against_it() -> None:
    maps = [labels.copy() for labels in TRUE]
    for labels in maps[1:]:
        labels[labels == 3] = 0

    def brown_from_view_2(view: int) -> np.ndarray:
        return np.where((TRUE[view] == 3)[..., None] & (view > 1), np.uint8(BROWN), photo(view))

    revised = revise(maps, photos=brown_from_view_2)
    assert revised.instance_ids.unique().tolist() == [1, 2]  # found in one of six, green in two


def doubted(instance: int, **changes: torch.Tensor) -> dict[int, LeafSurface]:
    return LEAVES | {instance: replace(LEAVES[instance], **changes)}


@pytest.mark.parametrize(("score", "num_left"), [(0.8, 6), (0.2, 0)])
def test_masks_that_the_detector_is_sure_of_need_no_credible_surface(score: float, num_left: int) -> None:
    regions, ids = as_regions(TRUE)
    masks = detected(regions, ids, torch.where(ids == 3, score, 0.7))
    surfaces = doubted(3, iou=torch.full((6,), 0.5, dtype=torch.float64))
    revised = revise_masks(masks, surfaces, cameras=CAMERAS, photos=photo)
    assert int((revised.instance_ids == 3).sum()) == num_left
    assert not is_new(revised).any()


def test_without_a_credible_surface_most_masks_must_be_sure() -> None:
    regions, ids = as_regions(TRUE)
    is_unsure = (ids == 3) & (regions.view_index > 1)
    masks = detected(regions, ids, torch.where(is_unsure, 0.2, 0.7))
    surfaces = doubted(3, iou=torch.full((6,), 0.5, dtype=torch.float64))
    assert revise_masks(masks, surfaces, cameras=CAMERAS, photos=photo).instance_ids.unique().tolist() == [1, 2]


@pytest.mark.parametrize(("score", "is_kept"), [(0.9, True), (0.1, False)])
def test_a_sure_mask_that_disagrees_stays_and_an_unsure_one_is_replaced(score: float, is_kept: bool) -> None:
    """The mask of leaf 3 lies half beside it in view 4."""
    maps = [labels.copy() for labels in TRUE]
    rows, columns = np.nonzero(TRUE[4] == 3)
    width = int(np.ptp(columns))
    maps[4][TRUE[4] == 3] = 0
    maps[4][rows, np.clip(columns - width // 2, 0, SIZE - 1)] = 3
    regions, ids = as_regions(maps)
    here = (regions.view_index == 4) & (ids == 3)
    revised = revise_masks(detected(regions, ids, torch.where(here, score, 0.7)), LEAVES, cameras=CAMERAS, photos=photo)
    assert bool(is_new(revised).any()) != is_kept
    assert np.array_equal(label_maps(revised)[4] == 3, (maps if is_kept else TRUE)[4] == 3)


def test_what_is_found_in_half_of_the_views_is_added_to_the_others() -> None:
    maps = [labels.copy() for labels in TRUE]
    for labels in maps[3:]:
        labels[labels == 3] = 0
    revised = revise(maps)
    assert int((revised.instance_ids == 3).sum()) == 6


def test_photos_know_better_what_lies_in_front() -> None:
    """Leaf 2 is drawn behind leaf 1; the photos show it before that one."""
    maps = [labels.copy() for labels in TRUE]
    hidden = 0
    for view, labels in enumerate(maps):
        for leaf in visible_leaves(LEAVES, CAMERAS, view):
            if leaf.instance == 2:
                x1, y1, x2, y2 = leaf.box
                hidden += int((leaf.covered & ~leaf.mask).sum())
                labels[y1:y2, x1:x2][leaf.covered] = 2
    assert hidden > 0
    revised = revise(maps)
    shown = label_maps(revised)
    assert all(np.array_equal(one == 2, other == 2) for one, other in zip(shown, maps, strict=True))
    assert not is_new(revised)[revised.instance_ids == 2].any()


def test_masks_with_each_others_ids_are_swapped_before_they_are_judged() -> None:
    regions, ids = as_regions(TRUE)
    wrong = ids.clone()
    in_view = regions.view_index == 2
    wrong[in_view & (ids == 1)], wrong[in_view & (ids == 2)] = 2, 1
    moved, left = move_masks(detected(regions, wrong), LEAVES, cameras=CAMERAS)
    assert torch.equal(moved.instance_ids, ids)
    assert left == LEAVES
    revised = revise_masks(moved, left, cameras=CAMERAS, photos=photo)
    assert not is_new(revised).any()
    assert len(revised) == num_masks(TRUE)


def test_the_order_of_masks_does_not_matter() -> None:
    maps = [labels.copy() for labels in TRUE]
    maps[2][maps[2] == 1] = 0
    regions, ids = as_regions(maps)
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(2))
    one, other = (
        revise_masks(detected(part, numbers), LEAVES, cameras=CAMERAS, photos=photo)
        for part, numbers in ((regions, ids), (regions.select(order), ids[order]))
    )
    assert torch.equal(one.regions.crops, other.regions.crops)
    assert torch.equal(one.instance_ids, other.instance_ids)
    assert torch.equal(one.origin, other.origin)


def test_nothing_found() -> None:
    regions, ids = as_regions([np.zeros((SIZE, SIZE), np.int64)] * 6)
    revised = revise_masks(detected(regions, ids), {}, cameras=CAMERAS, photos=photo)
    assert len(revised) == revised.num_instances == 0
    assert revised.regions.num_views == 6


def test_cameras_on_one_side_verify_nothing() -> None:
    regions, ids = as_regions(TRUE)
    masks = detected(regions, ids)
    apart = median_parallax(masks, CAMERAS)
    assert apart > 60
    K = CAMERAS.K.clone()
    K[:, :2, :2] *= 10
    alike = replace(CAMERAS, R=CAMERAS.R[:1].repeat(len(CAMERAS), 1, 1), K=K)
    with pytest.warns(InputWarning, match="from one side only"):
        kept, surfaces = verify_masks(masks, cameras=alike, photos=photo)
    assert torch.equal(kept.regions.crops, regions.crops)
    assert torch.equal(kept.instance_ids, ids)
    assert surfaces == {}
    assert median_parallax(detected(regions, torch.full_like(ids, -1)), CAMERAS) == float("inf")
