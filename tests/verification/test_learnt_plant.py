"""What a person's edits say of a plant, and how far that shifts the scores."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar
from scipy.special import expit, logit

from blade_scene import as_regions
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import Leaves, choose_leaves
from mvseg.verification.leaf_scores import FITTED
from mvseg.verification.learnt_plant import LEAF_SHIFT, Labels, label_leaves, learn_plant, learn_shift
from three_leaves import CAMERAS, LEAVES, true_maps

REGIONS, IDS = as_regions(true_maps())
PROPOSALS = Masks.of(
    replace(REGIONS, labels=torch.arange(len(REGIONS))),
    detection_scores=torch.full((len(REGIONS),), 0.8),
    origin=Origin.DETECTED,
)
MATCHED = replace(PROPOSALS, instance_ids=IDS, match_scores=torch.full((len(IDS),), 0.9))
NO_LABELS = Labels(np.zeros(0), np.zeros(0, bool))


def fit(masks: Masks, _: Cameras) -> dict[int, LeafSurface]:
    ids = masks.instance_ids
    return {each: LEAVES[int(IDS[masks.regions.labels[ids == each]].mode().values)] for each in ids.unique().tolist()}


def choose(matched: Masks, proposals: Masks, **more: Any) -> Leaves:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvseg.verification.choose.fit_roughly", fit)
        return choose_leaves(matched, proposals, cameras=CAMERAS, **more)


ALONE = choose(MATCHED, PROPOSALS)


def say(matched: Masks = MATCHED, held: object = (), rejected: object = (), alone: Leaves = ALONE) -> Labels:
    is_held = np.isin(np.arange(len(matched)), held)  # type: ignore[call-overload]
    return label_leaves(alone, matched, is_held=is_held, rejected=rejected, cameras=CAMERAS)  # type: ignore[arg-type]


def row_of(leaf: int, view: int) -> int:
    return int(((leaf == IDS) & (REGIONS.view_index == view)).nonzero()[0, 0])


def pixel_of(leaf: int, view: int) -> tuple[int, int, int]:
    """View, x and y of a pixel of a leaf."""
    row = row_of(leaf, view)
    y, x = (REGIONS.crop(row).nonzero()[0] + REGIONS.boxes[row, [1, 0]]).tolist()
    return view, x, y


# --- the shift


def test_without_labels_nothing_changes() -> None:
    assert learn_plant(NO_LABELS) == FITTED


def test_the_shift_is_the_most_probable_one() -> None:
    """Against the posterior itself, maximized numerically."""
    rng = np.random.default_rng(0)
    for count in (1, 3, 40):
        chances, is_right = rng.uniform(0.02, 0.98, count), rng.random(count) < 0.5

        def against(shift: float, chances: np.ndarray = chances, right: np.ndarray = is_right) -> float:
            odds = logit(chances) + shift
            likelihood = np.log(np.where(right, expit(odds), expit(-odds))).sum()
            return float(shift**2 / (2 * LEAF_SHIFT**2) - likelihood)

        best = minimize_scalar(against, bounds=(-5, 5), method="bounded", options={"xatol": 1e-9}).x
        assert learn_shift(Labels(chances, is_right)) == pytest.approx(best, abs=1e-5)


def test_labels_of_one_kind_move_it_on_and_on() -> None:
    for kind in (True, False):
        shifts = [learn_shift(Labels(np.full(n, 0.5), np.full(n, kind))) for n in range(60)]
        steps = np.diff(shifts)
        assert (steps > 0).all() if kind else (steps < 0).all()
    ten = learn_shift(Labels(np.full(10, 0.5), np.zeros(10, bool)))
    assert expit(ten) == pytest.approx(1 / 3, abs=0.02)
    many = Labels(np.ones(10**4), np.zeros(10**4, bool))
    assert learn_shift(many) < -5  # no prior outweighs them


def test_yes_and_no_are_mirror_images() -> None:
    rng = np.random.default_rng(1)
    chances, is_right = rng.random(9), rng.random(9) < 0.3
    shift = learn_shift(Labels(chances, is_right))
    assert learn_shift(Labels(1 - chances, ~is_right)) == pytest.approx(-shift, abs=2e-6)
    order = rng.permutation(9)
    assert learn_shift(Labels(chances[order], is_right[order])) == shift


def test_only_the_first_numbers_shift_and_those_of_masks_do_not() -> None:
    learnt = learn_plant(Labels(np.array([0.3, 0.6]), np.array([True, True])))
    for name in ("leaf", "found"):
        assert getattr(learnt, name)[0] > getattr(FITTED, name)[0]
        assert getattr(learnt, name)[1:] == getattr(FITTED, name)[1:]
    assert (learnt.shows, learnt.matched) == (FITTED.shows, FITTED.matched)


# --- the labels


def test_what_nobody_touched_is_no_label() -> None:
    labels = say()
    assert [len(each) for each in vars(labels).values()] == [0, 0]


def test_a_mask_that_a_person_confirmed_shows_its_leaf_and_so_it_is_one() -> None:
    labels = say(held=[row_of(2, 1), row_of(2, 3)])
    leaf = int(ALONE.masks.instance_ids[(ALONE.masks.regions.boxes == REGIONS.boxes[row_of(2, 1)]).all(1)][0])
    assert labels.chances.tolist() == [ALONE.probabilities[leaf]]
    assert labels.is_leaf.tolist() == [True]


def test_what_is_rejected_in_all_photos_is_no_leaf_and_one_mask_says_nothing() -> None:
    everywhere = say(MATCHED.select(IDS != 3), rejected=[(*pixel_of(3, 0), True)])
    assert everywhere.is_leaf.tolist() == [False]
    assert len(say(rejected=[(*pixel_of(3, 0), False)]).is_leaf) == 0
    assert len(say(rejected=[(0, 0, 0, True)]).is_leaf) == 0  # nothing is there


def test_a_mask_that_a_person_gave_to_another_leaf_says_nothing_of_the_first() -> None:
    moved = replace(MATCHED, instance_ids=IDS.clone())
    moved.instance_ids[row_of(1, 2)] = 3
    labels = say(moved, held=[row_of(1, 2), row_of(3, 0)])
    assert labels.is_leaf.tolist() == [True]  # leaf 3


def test_what_was_said_both_ways_is_left_out() -> None:
    labels = say(held=[row_of(2, 1)], rejected=[(*pixel_of(2, 4), True)])
    assert [len(each) for each in vars(labels).values()] == [0, 0]


def test_neither_the_order_of_masks_nor_that_of_edits_matters() -> None:
    order = torch.randperm(len(IDS), generator=torch.Generator().manual_seed(2))
    held, rejected = [row_of(1, 2), row_of(3, 4)], [(*pixel_of(2, 0), True), (*pixel_of(2, 4), True)]
    one = say(held=held, rejected=rejected)
    place = [int((order == row).nonzero()[0, 0]) for row in held]
    two = say(MATCHED.select(order), held=place, rejected=rejected[::-1])
    assert learn_plant(one) == learn_plant(two) != FITTED


def test_nothing_chosen_is_nothing_to_label() -> None:
    nothing = PROPOSALS.select(torch.zeros(0, dtype=torch.int64))
    alone = choose(nothing, nothing)
    assert learn_plant(say(held=[0], alone=alone)) == FITTED


# --- what follows


def test_a_doubtful_leaf_falls_when_others_like_it_were_none_and_what_a_person_confirmed_stays() -> None:
    """The masks of leaf 3 score low; it is chosen or not as the scores of the plant say."""
    scores = torch.where(IDS == 3, 0.1, 0.8)
    proposals, matched = (replace(each, detection_scores=scores) for each in (PROPOSALS, MATCHED))
    strict = learn_plant(Labels(np.full(40, 0.6), np.zeros(40, bool)))
    plain, learnt = (
        choose(matched, proposals, fitted=fitted) for fitted in (FITTED, strict)
    )
    assert len(plain.probabilities) == 3
    assert len(learnt.probabilities) == 2
    confirmed = replace(matched, origin=torch.where(IDS == 3, int(Origin.CONFIRMED), matched.origin))
    kept = choose(confirmed, proposals, fitted=strict)
    assert 1.0 in kept.probabilities.values()
    assert int((kept.masks.origin == Origin.CONFIRMED).sum()) == int((IDS == 3).sum())
