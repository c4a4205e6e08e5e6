"""Which leaf given masks show: three known leaves, seen by six cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import logit
from torch import Tensor

from blade_scene import SIZE, as_regions
from matched import matched
from mvseg.masks import Masks, MergedMask
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.verification.checked_ids import check_ids
from mvseg.verification.shown_leaves import GIVEN, MaskQuestion, ask, assign, settle_masks, show_odds
from three_leaves import CAMERAS, LEAVES, true_maps

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


def question_of(masks: Masks, surfaces: dict[int, LeafSurface]) -> MaskQuestion:
    return MaskQuestion.of(masks, surfaces, CAMERAS, is_held=np.zeros(len(masks), bool))


def test_the_masks_of_a_scattered_leaf_find_each_other(scattered: tuple[Regions, Tensor, Tensor]) -> None:
    regions, leaves, ids = scattered
    is_second = leaves == 2
    rows = is_second.nonzero()[:, 0].tolist()
    merged = [MergedMask(region=rows[0], own=1, other=3, part=regions.crop(rows[0]))]
    masks = unsure(regions, ids, is_second).with_merged(merged)
    found = check_ids(masks, SURFACES, cameras=CAMERAS)
    assert torch.equal(found.instance_ids, torch.where(is_second, 4, ids))
    assert torch.equal(found.match_scores[~is_second], masks.match_scores[~is_second])
    assert found.match_scores[is_second].min() > 0.5
    assert found.merged == ()
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(3))
    again = check_ids(masks.select(order), SURFACES, cameras=CAMERAS)
    assert torch.equal(again.instance_ids, found.instance_ids[order])


@pytest.mark.parametrize("reason", ["held", "another method"])
def test_other_masks_stay(scattered: tuple[Regions, Tensor, Tensor], reason: str) -> None:
    regions, leaves, ids = scattered
    is_second = leaves == 2
    masks = unsure(regions, ids, is_second)
    if reason == "held":
        masks = replace(masks, is_linked=is_second)
    config = MatchConfig(num_instances=3) if reason == "another method" else MatchConfig()
    found = check_ids(masks, SURFACES, cameras=CAMERAS, config=config)
    assert torch.equal(found.instance_ids, ids)


def test_a_leaf_that_is_not_worth_its_price_is_not_there(scattered: tuple[Regions, Tensor, Tensor]) -> None:
    regions, leaves, ids = scattered
    masks = unsure(regions, ids, leaves == 2)
    nothing = np.zeros(len(masks), bool)
    question = ask(masks, SURFACES, cameras=CAMERAS, config=MatchConfig(), is_held=nothing)
    assert question.is_known.tolist() == [True, True, False]
    assert (settle_masks(question)[0] == 2).tolist() == (leaves == 2).tolist()
    assert (settle_masks(question, replace(GIVEN, price=1000.0))[0] == question.leaf).all()


def test_a_mask_joins_the_leaf_that_it_shows_or_stays() -> None:
    """In view 0, leaf 2 has the id of leaf 1, which has no mask there; in view 3 a mere spot has the id of leaf 3."""
    maps = true_maps()
    maps[0][maps[0] == 1] = 0
    maps[3][maps[3] == 3] = 0
    maps[3][5:25, 5:25] = 13
    regions, leaves = as_regions(maps)
    is_wrong = (leaves == 13) | ((leaves == 2) & (regions.view_index == 0))
    ids = torch.where(leaves == 13, 3, torch.where(is_wrong, 1, leaves))
    found = check_ids(unsure(regions, ids, is_wrong), LEAVES, cameras=CAMERAS)
    assert torch.equal(found.instance_ids, torch.where(leaves == 13, 3, leaves))
    assert found.match_scores[leaves == 13].tolist() == [0.5]


def test_log_odds_are_those_of_features_counted_on_whole_frames() -> None:
    maps = true_maps()
    regions, ids = as_regions(maps)
    masks = matched(regions, ids, 0.8).masks
    odds = show_odds(question_of(masks, LEAVES))
    of_two_classes = show_odds(question_of(replace(masks, classes=1 + (ids == 2).long()), LEAVES))
    assert np.isneginf(of_two_classes[(ids == 2).numpy()][:, [0, 2]]).all()
    assert (of_two_classes[:, 1] == np.where(ids == 2, odds[:, 1], -np.inf)).all()
    without = show_odds(question_of(masks, {1: LEAVES[1], 2: LEAVES[2]}))[:, 2]  # of leaf 3, which has no surface
    assert without[(ids == 3).numpy()] == pytest.approx(np.dot([*GIVEN.shows.values()][5:], [1, logit(0.8)]), abs=1e-6)
    assert np.isneginf(without[(ids != 3).numpy()]).all()
    for row in range(0, len(ids), 3):
        view = int(regions.view_index[row])
        mask = regions.mask(row, SIZE, SIZE).numpy()
        for column, leaf in enumerate(LEAVES):
            whole, seen = LEAVES[leaf].project(CAMERAS[[view]])[0].numpy(), maps[view] == leaf
            if not (mask & whole).any() and leaf != ids[row]:
                assert odds[row, column] == -np.inf
                continue
            shares = [(mask & seen).sum() / (mask | seen).sum(), (mask & whole).sum() / mask.sum()]
            is_own = leaf == int(ids[row])
            features = [1, logit(0.8) * is_own, not is_own, *logit(np.clip(shares, 0.01, 0.99))]
            assert odds[row, column] == pytest.approx(np.dot([*GIVEN.shows.values()][:5], features), abs=1e-6)


def test_of_two_masks_with_the_same_pixels_one_stays() -> None:
    """It was matched to another leaf; without common pixels, it would be a piece."""
    regions, ids = as_regions(true_maps())
    twice = regions.select(torch.cat((torch.arange(len(ids)), torch.tensor([0]))))
    question = question_of(matched(twice, torch.cat((ids, torch.tensor([3])))).masks, LEAVES)
    odds = show_odds(question)
    assert odds[-1, 0] > 0 > odds[-1, 2]
    assert (assign(question, odds, question.is_known)[0] == question.leaf).all()
    apart = replace(question, drawn=[replace(each, masks=0 * each.masks) for each in question.drawn])
    assert assign(apart, odds, question.is_known)[0].tolist() == [*question.leaf[:-1].tolist(), 0]
