"""The queue of doubts: three known leaves in six views, and one fault at a time."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from blade_scene import as_regions
from known_leaves import make_surface
from mvseg.corrections.mask_questions import MaskQuestion, list_mask_questions
from mvseg.corrections.numbers import QUESTIONS
from mvseg.masks import Masks, Origin
from mvseg.verification.choose import RejectedCandidate
from three_leaves import CAMERAS, LEAVES, true_maps

TRUE = true_maps()


def masks_of(maps: list[np.ndarray]) -> Masks:
    """Labels from 100 on are masks that were matched to nothing."""
    regions, numbers = as_regions(maps)
    ids = torch.where(numbers >= 100, -1, numbers)
    return Masks.of(regions, ids, torch.where(ids > 0, 0.95, 0.0))


def doubts(masks: Masks, **changes: object) -> list[MaskQuestion]:
    return list_mask_questions(masks, LEAVES, cameras=CAMERAS, **changes)  # type: ignore[arg-type]


def row_of(masks: Masks, *, view: int, leaf: int) -> int:
    return int(((masks.view_index == view) & (masks.instance_ids == leaf)).nonzero()[0])


def changed(view: int, leaf: int, number: int) -> Masks:
    """The true masks; that of one leaf in one view has another number."""
    maps = [labels.copy() for labels in TRUE]
    maps[view][maps[view] == leaf] = number
    return masks_of(maps)


def fill(view: int, outline: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels inside an outline."""
    return cv2.fillPoly(np.zeros(TRUE[view].shape, np.uint8), [np.round(outline - 0.5).astype(np.int32)], 1) > 0


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_low_scores_come_first_the_lowest_before_the_others() -> None:
    masks = masks_of(TRUE)
    rows = [row_of(masks, view=view, leaf=leaf) for view, leaf in ((1, 2), (4, 3), (0, 1), (2, 3))]
    masks.match_scores[rows] = torch.tensor([0.5, 0.1, 1 - QUESTIONS.least + 0.01, 0.3])
    found = doubts(masks)
    assert [(each.kind, each.view, each.instance, each.region) for each in found] == [
        ("leaf", 4, 3, rows[1]), ("leaf", 1, 2, rows[0])
    ]  # fmt: skip
    for each in found:  # what it is compared with shows the same leaf elsewhere
        assert masks.instance_ids[each.other] == each.instance
        assert masks.view_index[each.other] != each.view


def test_a_missing_mask_is_proposed_where_the_surface_is_seen() -> None:
    (found,) = doubts(changed(2, 1, 0))
    assert (found.kind, found.view, found.instance, found.region) == ("place", 2, 1, -1)
    assert found.num_found == found.num_expected - 1
    ((view, outline),) = found.outlines
    assert view == 2
    assert iou(fill(view, outline), TRUE[2] == 1) > 0.9


def test_a_mask_of_no_leaf_may_be_the_leaf_that_should_be_there_or_none() -> None:
    masks = changed(2, 1, 100)
    (found,) = doubts(masks)
    lone = int((masks.instance_ids == -1).nonzero()[0])
    assert (found.kind, found.view, found.instance, found.region) == ("leaf", 2, 1, lone)
    maps = [labels.copy() for labels in TRUE]
    maps[1][:40, :40] = np.where(maps[1][:40, :40] == 0, 100, maps[1][:40, :40])
    (found,) = doubts(masks_of(maps))
    assert (found.kind, found.view, found.instance, found.other) == ("leaf", 1, -1, -1)
    maps[1][:40, :40] = np.where(maps[1][:40, :40] == 100, 0, maps[1][:40, :40])
    maps[1][:3, :3] = 100
    assert doubts(masks_of(maps)) == []  # a crumb


def test_a_leaf_of_few_views_is_asked_about_once() -> None:
    maps = [np.where((labels == 3) & (view != 0), 0, labels) for view, labels in enumerate(TRUE)]
    few = [each for each in doubts(masks_of(maps)) if each.kind == "leaf"]
    whole = [int(mask.sum()) for mask in LEAVES[3].project(CAMERAS)]
    openly = sum((labels == 3).sum() >= 0.5 * size for labels, size in zip(TRUE, whole, strict=True))
    assert [(each.instance, each.view, each.num_found, each.num_expected) for each in few] == [(3, 0, 1, openly)]
    masks = masks_of(maps)
    masks.match_scores[row_of(masks, view=4, leaf=2)] = 0.6
    first, second = list_mask_questions(masks, None, cameras=CAMERAS)  # the larger change first
    assert (first.instance, first.num_found, first.num_expected) == (3, 1, 6)  # without surfaces, every view should
    assert second.instance == 2


def test_the_mask_that_its_surface_explains_worst_is_asked_about() -> None:
    iou = torch.full((6,), 0.9, dtype=torch.float64)
    iou[[3, 4]] = torch.tensor([0.6, 0.4], dtype=torch.float64)
    surfaces = LEAVES | {2: replace(make_surface(LEAVES[2].coefficients.numpy()), iou=iou)}
    masks = masks_of(TRUE)
    (found,) = list_mask_questions(masks, surfaces, cameras=CAMERAS)
    assert (found.kind, found.view, found.region) == ("leaf", 4, row_of(masks, view=4, leaf=2))


@pytest.mark.parametrize("is_drawn", [True, False])
def test_what_a_person_said_is_not_asked_again(is_drawn: bool) -> None:
    masks = masks_of(TRUE)
    rows = [row_of(masks, view=view, leaf=2) for view in (1, 2)]
    masks.match_scores[rows] = torch.tensor([0.1, 0.2])
    for row in rows:  # the next mask of the leaf follows
        assert [each.region for each in doubts(masks)] == [row]
        if is_drawn:
            masks.origin[row] = int(Origin.CORRECTED)
        masks.is_linked[row] = not is_drawn
    assert doubts(masks) == []


def test_nothing_is_asked_of_a_result_without_faults_masks_or_surfaces() -> None:
    assert doubts(masks_of(TRUE)) == []
    empty = masks_of([np.zeros_like(labels) for labels in TRUE])
    assert list_mask_questions(empty, None, cameras=CAMERAS) == []
    assert list_mask_questions(masks_of(TRUE), {}, cameras=CAMERAS) == []


def leave_out(leaf: int, chance: float, *views: int) -> RejectedCandidate:
    """The true masks of a leaf in some views, as a candidate that was not chosen."""
    masks = masks_of(TRUE)
    keep = (masks.instance_ids == leaf) & torch.isin(masks.view_index, torch.tensor(views))
    return RejectedCandidate(chance, masks.select(keep))


def without(leaf: int) -> Masks:
    return masks_of([np.where(labels == leaf, 0, labels - (labels > leaf)) for labels in TRUE])


def test_a_candidate_that_was_not_chosen_is_shown_in_all_its_views_unless_it_is_unlikely() -> None:
    surfaces = {1: LEAVES[1], 2: LEAVES[3]}
    found = list_mask_questions(without(2), surfaces, cameras=CAMERAS, rejected=(leave_out(2, 0.4, 0, 2, 4),))
    (asked,) = [each for each in found if each.region < 0]
    assert sorted(view for view, _ in asked.outlines) == [0, 2, 4]
    assert (asked.view, asked.region, asked.instance) == (asked.outlines[0][0], -1, -1)
    assert 0 < asked.change <= 0.4 * 3
    assert min(iou(fill(view, outline), TRUE[view] == 2) for view, outline in asked.outlines) > 0.9
    surfaces = {1: LEAVES[1], 2: LEAVES[3]}
    left = leave_out(2, 0.09, 0, 2, 4), leave_out(2, 0.5, 3), leave_out(1, 0.5, 0, 1, 2)
    assert list_mask_questions(without(2), surfaces, cameras=CAMERAS, rejected=left) == []


GREEN, BROWN = (60, 160, 40), (120, 80, 40)
PHOTOS = [np.where(labels[..., None] > 0, GREEN, BROWN).astype(np.uint8) for labels in TRUE]


def test_large_places_that_look_like_leaves_come_first() -> None:
    masks = masks_of([np.where(labels == 3, 1, 0) for labels in TRUE])
    photos = [np.where((labels == 1)[..., None], BROWN, photo) for labels, photo in zip(TRUE, PHOTOS, strict=True)]
    masks.match_scores[0] = 0.01
    read = [photo.astype(np.uint8) for photo in photos].__getitem__
    first, *others = list_mask_questions(masks, None, cameras=CAMERAS, photos=read)
    assert (first.kind, first.instance, first.region) == ("place", -1, -1)
    assert [each.kind for each in others] == ["leaf"]
    assert len(first.outlines) >= 4
    assert min((TRUE[view][fill(view, outline)] == 2).mean() for view, outline in first.outlines) > 0.9
    sizes = [cv2.contourArea(outline.astype(np.float32)) for _, outline in first.outlines]
    assert sizes == sorted(sizes, reverse=True)
    photos[1:] = [np.where(photo == GREEN, BROWN, photo) for photo in photos[1:]]
    found = list_mask_questions(masks, None, cameras=CAMERAS, photos=[p.astype(np.uint8) for p in photos].__getitem__)
    assert "place" not in {each.kind for each in found}  # nothing that one photo shows becomes a leaf


def halved(views: tuple[int, ...]) -> Masks:
    """The true masks; those of leaf 2 show its upper half in some views."""
    maps = [labels.copy() for labels in TRUE]
    for view in views:
        rows, columns = np.nonzero(maps[view] == 2)
        order = np.argsort(rows, kind="stable")[len(rows) * 4 // 10 :]
        maps[view][rows[order], columns[order]] = 0
    return masks_of(maps)


def test_half_masks_of_a_leaf_are_one_question() -> None:
    views = tuple(view for view, labels in enumerate(TRUE) if (labels == 2).sum() > 0.5 * (TRUE[0] == 2).sum())
    found = list_mask_questions(halved(views), None, cameras=CAMERAS, photos=PHOTOS.__getitem__)
    half = [each for each in found if each.kind == "half"]
    assert [(each.instance, len(each.outlines) >= 3) for each in half] == [(2, True)]
    assert found[0] is half[0]
    assert {view for view, _ in half[0].outlines} <= {*views}
    few = list_mask_questions(halved(views[:2]), None, cameras=CAMERAS, photos=PHOTOS.__getitem__)
    assert {each.kind for each in few} <= {"place"}


def test_the_widest_place_of_leaves_that_hang_together_is_asked_about() -> None:
    """A leaf without masks, on a band of its colour that leaves the photo."""
    bare = [np.where(labels > 1, labels, 0) for labels in TRUE]
    photos = []
    for labels, photo in zip(TRUE, PHOTOS, strict=True):
        painted = photo.copy()
        row = int(np.nonzero(labels == 1)[0].mean())
        painted[row - 4 : row + 4][labels[row - 4 : row + 4] == 0] = GREEN
        photos.append(painted)
    found = list_mask_questions(masks_of(bare), None, cameras=CAMERAS, photos=photos.__getitem__)
    assert found[0].kind in ("place", "half")  # it lies beside another leaf
    assert min((TRUE[view][fill(view, outline)] == 1).mean() for view, outline in found[0].outlines) > 0.5
