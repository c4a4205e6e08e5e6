"""Overlays: colours, places and sizes."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from mvseg.masks import Masks
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.results.overlay import MARGIN, MAX_SIDE, UNMATCHED, draw_overlay, find_plant, instance_color

GREY = np.full((200, 300, 3), 90, np.uint8)


def masks(regions: Regions, ids: list[int], scores: list[float] | None = None) -> Masks:
    ids = ids[: len(regions)]
    return Masks.of(regions, torch.tensor(ids, dtype=torch.int64), torch.tensor(scores or [0.9] * len(ids)))


@pytest.fixture
def regions() -> Regions:
    """Two views; in both, number 1 is a large square and number 2 a small one inside of it."""
    labels = np.zeros((200, 300), np.uint16)
    labels[20:180, 20:180], labels[60:90, 60:90] = 1, 2
    return regions_from_label_maps([labels, labels[:, ::-1]])


def test_colours_differ_and_an_instance_has_one_in_every_view(regions: Regions) -> None:
    colors = [instance_color(instance) for instance in range(1, 41)]
    assert len(set(colors)) == 40
    assert instance_color(-1) == UNMATCHED
    assert UNMATCHED not in colors
    gaps = [np.abs(np.subtract(color, following)).max() for color, following in pairwise(colors)]
    assert min(gaps) > 60  # neighbouring numbers
    ids = masks(regions, [5, 1, 5, 1])
    first, second = (draw_overlay(GREY, ids, view=view) for view in (0, 1))
    tint = (0.45 * 90 + 0.55 * np.array(instance_color(5))).astype(np.uint8)
    assert (first[30:50, 30:50] == tint).all()
    assert (second[30:50, 250:270] == tint).all()
    assert (first[:, 190:] == 90).all()  # outside nothing changes
    assert (GREY == 90).all()


def test_drawing_in_the_box_of_a_mask_is_drawing_in_the_whole_picture() -> None:
    noise = np.random.default_rng(0).random((25, 38))
    labels = np.kron((noise > 0.7).astype(np.uint16), np.ones((8, 8), np.uint16))[:200, :300]  # up to every border
    regions = regions_from_label_maps([labels])
    expected = GREY.copy()
    expected[labels > 0] = 0.45 * GREY[labels > 0] + 0.55 * np.array(UNMATCHED)
    outlines, _ = cv2.findContours(labels.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(expected, outlines, -1, UNMATCHED, 1)
    np.testing.assert_array_equal(draw_overlay(GREY, masks(regions, [-1]), view=0), expected)
    labels = np.zeros((2400, 3200), np.uint16)
    labels[12, 13] = 1  # between the pixels that the overlay takes
    photo = np.full((2400, 3200, 3), 90, np.uint8)
    assert (draw_overlay(photo, masks(regions_from_label_maps([labels]), [1]), view=0) == 90).all()


def test_the_small_one_is_on_top(regions: Regions) -> None:
    labels = np.zeros((200, 300), np.uint16)
    labels[20:180, 20:180] = 1
    below = regions_from_label_maps([labels])
    both = Regions(
        view_index=torch.zeros(2, dtype=torch.int64),
        boxes=torch.cat((regions.boxes[1:2], below.boxes)),
        crops=torch.cat((regions.crop(1).flatten(), below.crops)),
        num_views=1,
        labels=torch.tensor([1, 2]),
    )
    painted = draw_overlay(GREY, masks(both, [1, 2]), view=0)
    small = 0.45 * 90 + 0.55 * np.array(instance_color(1))
    assert np.abs(painted[62:64, 62:64] - small).max() <= 1


def test_unmatched_regions_are_grey_and_without_number(regions: Regions) -> None:
    painted = draw_overlay(GREY, masks(regions, [-1, -1, 1, 1]), view=0)
    assert (painted[..., 0] == painted[..., 1]).all()
    assert (painted[..., 1] == painted[..., 2]).all()
    assert painted.max() == UNMATCHED[0]
    numbered = draw_overlay(GREY, masks(regions, [-1, -1, 1, 1]), view=1)
    assert numbered.max() == 255  # the white rim of a number


def test_large_photos_are_scaled_down_and_a_view_without_regions_is_the_photo(regions: Regions) -> None:
    labels = np.zeros((1000, 4000), np.uint16)
    labels[400:600, 1000:1400] = 1
    photo = np.full((1000, 4000, 3), 90, np.uint8)
    painted = draw_overlay(photo, masks(regions_from_label_maps([labels]), [1]), view=0)
    assert painted.shape == (400, MAX_SIDE, 3)
    tint = (0.45 * 90 + 0.55 * np.array(instance_color(1))).astype(np.uint8)
    assert (painted[165:170, 405:410] == tint).all()
    nothing = regions.select(regions.view_index == 1)
    np.testing.assert_array_equal(draw_overlay(GREY, masks(nothing, [1, 2]), view=0), GREY)


def test_unsure_matches_are_marked(regions: Regions) -> None:
    sure, surer, unsure = (
        draw_overlay(GREY, masks(regions, [1, 2, 1, 2], [score, 0.9, 0.9, 0.9]), view=0) for score in (0.5, 0.9, 0.4)
    )
    np.testing.assert_array_equal(sure, surer)
    assert (unsure != sure).any()


class TestFindPlant:
    def test_it_is_around_what_is_matched(self) -> None:
        """A plant of a tenth of the width, and a mask elsewhere that is matched to nothing."""
        labels = np.zeros((600, 800), np.uint16)
        labels[300:360, 500:540], labels[300:330, 540:580] = 1, 2
        labels[10:60, 10:60] = 3
        found = regions_from_label_maps([labels])
        x1, y1, x2, y2 = find_plant(masks(found, [1, 2, -1]), view=0, size=(800, 600))
        assert (x1 + x2) / 2 == pytest.approx(540, abs=1)
        assert (y1 + y2) / 2 == pytest.approx(330, abs=1)
        assert x2 - x1 == pytest.approx((1 + 2 * MARGIN) * 80, abs=1)
        assert (x2 - x1) / (y2 - y1) == pytest.approx(4 / 3, abs=0.02)

    @pytest.mark.parametrize("at", [(0, 0), (0, 760), (560, 0), (560, 760)])
    def test_the_box_stays_in_the_photo(self, at: tuple[int, int]) -> None:
        labels = np.zeros((600, 800), np.uint16)
        labels[at[0] : at[0] + 40, at[1] : at[1] + 40] = 1
        x1, y1, x2, y2 = find_plant(masks(regions_from_label_maps([labels]), [1]), view=0, size=(800, 600))
        assert 0 <= x1 <= at[1] < at[1] + 40 <= x2 <= 800
        assert 0 <= y1 <= at[0] < at[0] + 40 <= y2 <= 600

    def test_without_matched_masks_it_is_the_photo(self, regions: Regions) -> None:
        for ids in ([-1, -1, 1, 2], [1, 2, -1, -1]):
            boxes = [find_plant(masks(regions, ids), view=view, size=(300, 200)) for view in (0, 1)]
            assert boxes.count((0, 0, 300, 200)) == 1

    def test_a_tiny_mask_is_not_blown_up(self) -> None:
        labels = np.zeros((600, 800), np.uint16)
        labels[300, 400] = 1
        x1, y1, x2, y2 = find_plant(masks(regions_from_label_maps([labels]), [1]), view=0, size=(800, 600))
        assert (x2 - x1, y2 - y1) == (40, 30)
