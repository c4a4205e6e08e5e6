"""The size at which most masks are expected to be right."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from found_masks import FoundMasks, open_photos
from mvseg import demo_scene, load_scene
from mvseg.config import RunConfig
from mvseg.detection.choose_size import choose_size
from mvseg.detection.config import DetectConfig
from mvseg.detection.find_leaves import find_leaves
from mvseg.errors import warn
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.verification.leaf_scores import expect_right


def squares(views: int, *, side: int = 20, score: float = 0.9) -> Masks:
    """A square in each of some views, all of one instance."""
    labels = np.zeros((60, 60), np.int64)
    labels[:side, :side] = 1
    regions, _ = as_regions([labels] * views)
    scores = torch.full((views,), score)
    return Masks.of(regions, torch.ones(views, dtype=torch.int64), scores, detection_scores=scores)


def look_of(masks: Masks, longest: int = 32) -> Any:
    return replace(FoundMasks.of(Matching(masks, MatchReport("none"))), longest=longest)


def expecting(right: float, longest: int = 800) -> Any:
    return SimpleNamespace(expected_right=right, looks=(SimpleNamespace(longest=longest),))


@pytest.mark.parametrize(
    ("expected", "asked", "best"),
    [
        ({}, [566], 0),  # fewer at the first step
        ({566: 130.0}, [566], 0),  # as many: the larger size stays
        ({566: 208.0, 400: 228.0, 283: 191.0, 200: 500.0}, [566, 400, 283], 400),  # as on a real croton
        ({566: 131, 400: 132, 283: 133, 200: 134, 141: 135, 100: 136, 71: 137, 50: 138, 35: 139}, None, 35),
    ],
)
def test_the_size_goes_down_as_long_as_more_is_expected(
    expected: dict[int, float], asked: list[int] | None, best: int
) -> None:
    looks: list[int] = []
    found = {0: expecting(130.0)} | {size: expecting(each) for size, each in expected.items()}

    def see(size: int) -> Any:
        looks.append(size)
        return found.get(size, expecting(0.0))

    assert choose_size(see, found[0]) is found[best]
    assert looks == (asked or [*expected])


def test_the_expected_number_of_right_masks() -> None:
    masks = Masks.concatenate((squares(4, score=0.5), squares(4, score=0.25)))
    assert expect_right(masks, {1: 0.8, 2: 0.4}) == pytest.approx(0.8 * 2 + 0.4 * 1)
    assert expect_right(masks, {}) == 0
    assert expect_right(masks.select(torch.arange(0)), {1: 1.0}) == 0


def test_what_two_looks_propose_is_one_set() -> None:
    """The labels of all matchings are rows of it."""
    both = find_leaves([look_of(squares(9, side=side)) for side in (40, 20)], load_scene(demo_scene()).cameras)
    assert len(both.proposals) == 18
    assert [int(each.regions.labels.min()) for each in both.matched] == [0, 0, 9, 9]
    for each in both.matched:
        assert torch.equal(each.regions.areas, both.proposals.regions.areas[each.regions.labels])


@pytest.mark.parametrize("size", [None, 300])
def test_looks_that_are_thrown_away_are_not_spoken_of(monkeypatch: pytest.MonkeyPatch, size: int | None) -> None:
    """Where the plant fills the photo, the detector looks again, unless somebody says at which size to look."""
    asked: list[int | None] = []

    def detect(_: object, config: DetectConfig, **__: object) -> Any:
        asked.append(config.image_size)
        warn(f"at {config.image_size}")
        return look_of(squares(9), longest=64)

    monkeypatch.setattr("mvseg.pipeline.find_in_photos.detect_scene", detect)
    with pytest.warns(UserWarning, match=f"at {size}") as caught:
        find_in_photos(open_photos(load_scene(demo_scene()), RunConfig(detect=DetectConfig(image_size=size))))
    assert asked == ([300] if size else [None, 45])
    assert not [each for each in caught if "at 45" in str(each.message)]
