"""What the other views say of masks: two known leaves over another, seen by six cameras, and masks with faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from blade_scene import SIZE, as_regions
from mvseg.errors import InputWarning
from mvseg.masks import Masks, Origin
from mvseg.regions import Regions
from mvseg.verification.other_views import median_parallax, revise_masks, verify_masks
from three_leaves import CAMERAS, LEAVES, true_maps

GREEN, BROWN = (70, 150, 50), (120, 90, 60)
TRUE = true_maps()


def num_masks(maps: list[np.ndarray]) -> int:
    return sum(len(np.unique(labels)) - 1 for labels in maps)


def photo(view: int) -> np.ndarray:
    """Green where a leaf is, brown elsewhere."""
    return np.array([BROWN, GREEN], np.uint8)[(TRUE[view] > 0).astype(int)]


def detected(regions: Regions, ids: torch.Tensor) -> Masks:
    return Masks.of(regions, ids, torch.where(ids > 0, 0.9, 0.0), origin=Origin.DETECTED)


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
