"""The size at which the agreed area is largest."""

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
from mvseg.detection.config import DetectConfig
from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.find_in_photos import choose_near, choose_size, find_in_photos
from mvseg.verification.leaf_scores import Rating, order_ratings, rate_pass
from warned import warns_of


def squares(views: int, *, side: int = 20, score: float = 0.9) -> Masks:
    """A square in each of some views, all of one instance."""
    labels = np.zeros((60, 60), np.int64)
    labels[:side, :side] = 1
    regions, _ = as_regions([labels] * views)
    scores = torch.full((views,), score)
    return Masks.of(regions, torch.ones(views, dtype=torch.int64), scores, detection_scores=scores)


def look_of(masks: Masks, longest: int = 32) -> Any:
    return replace(FoundMasks.of(Matching(masks, MatchReport("none"))), longest=longest)


def expecting(
    area: float, longest: int = 800, agreement: float = 0.9, *, leaves: int = 9, expected: float = 60.0
) -> Any:
    return SimpleNamespace(rating=Rating(area, expected, leaves), agreement=agreement, image_size=longest)


@pytest.mark.parametrize(
    ("expected", "asked", "best"),
    [
        ({}, [566], 0),  # less at the first step
        ({566: 208.0, 400: 228.0, 283: 191.0, 200: 500.0}, [566, 400, 283], 400),  # as on a real croton
        ({566: 133.0}, [566], 0),  # hardly more, which is chance: as on a dense basil
        ({566: 140, 400: 150, 283: 160, 200: 170, 141: 180, 100: 190, 71: 200, 50: 210, 35: 220}, None, 35),
    ],
)
def test_the_size_goes_down_as_long_as_the_agreed_area_grows(
    expected: dict[int, float], asked: list[int] | None, best: int
) -> None:
    looks: list[int] = []
    found = {0: expecting(130.0)} | {size: expecting(each) for size, each in expected.items()}

    def see(size: int) -> Any:
        looks.append(size)
        return found.get(size, expecting(0.0))

    assert choose_size(see, found[0])[0] is found[best]
    assert looks == (asked or [*expected])


def test_two_sizes_without_growth_end_nothing_where_the_views_hardly_agree() -> None:
    """As on a real muskmelon, in 8 of 20 photos."""
    areas = {566: 0.559, 400: 0.560, 283: 0.956, 200: 0.930, 141: 0.961, 100: 0.7, 71: 0.6, 50: 0.5}
    found = {size: expecting(area, agreement=0.7) for size, area in areas.items()}
    assert choose_size(found.__getitem__, expecting(0.567, agreement=0.7)) == [found[283], found[141]]
    found = {size: expecting(area) for size, area in areas.items()}
    first = expecting(0.567)
    assert choose_size(found.__getitem__, first) == [first, found[566]]


@pytest.mark.parametrize(
    ("areas", "most", "asked", "best"),
    [
        ({283: 200.0, 400: 227.0, 200: 180.0}, 1100, [283, 400, 200], 400),  # as of a muskmelon that was learned
        ({283: 200.0, 400: 200.0, 200: 200.0}, 1100, [283, 400, 200], 283),
        ({283: 200.0, 300: 210.0, 200: 220.0}, 300, [283, 300, 200], 200),
        ({40: 10.0}, 40, [40], 40),  # the photos are no larger, and 28 pixels are too few
    ],
)
def test_the_sizes_next_to_the_one_that_was_learned(
    areas: dict[int, float], most: int, asked: list[int], best: int
) -> None:
    looks: list[int] = []

    def see(size: int) -> Any:
        looks.append(size)
        return expecting(areas[size], size)

    assert choose_near(see, asked[0], most=most)[0].image_size == best
    assert looks == asked


def test_the_agreed_area_of_whole_leaves_is_larger_than_that_of_halves() -> None:
    def area_of(masks: Masks, probabilities: dict[int, float], pixel: float = 0, **colored: torch.Tensor) -> float:
        return rate_pass(masks, probabilities, pixel=pixel, **colored).agreed_area

    labels = np.zeros((60, 60), np.int64)
    labels[:40, :20] = 1
    halves = np.where(labels, 1 + (np.arange(60)[:, None] >= 20), 0)
    q = torch.full((4,), 0.5)
    whole = Masks.of(as_regions([labels] * 4)[0], torch.ones(4, dtype=torch.int64), q)
    assert area_of(whole, {1: 0.8}) == pytest.approx(0.4 * 4 * 800 * 0.4)
    assert area_of(whole, {}) == area_of(whole.select(torch.arange(0)), {1: 1.0}) == 0
    assert area_of(whole, {1: 0.8}, pixel=2) == pytest.approx(0.4 * 4 * (800**0.5 - 4) ** 2 * 0.4)
    regions = as_regions([halves] * 4)[0]
    sure = Masks.of(regions, regions.labels, torch.ones(8))
    assert area_of(sure, {1: 1.0, 2: 1.0}) == 4 * area_of(whole, {1: 1.0})  # in every photo
    mixed = sure.select((sure.view_index < 2) == (sure.instance_ids == 1))  # in half of the photos
    assert area_of(mixed, {1: 1.0, 2: 1.0}) == area_of(sure, {1: 1.0, 2: 1.0}) / 4
    half_green = torch.tensor([1.0, 1.0, 0.5, 0.5])  # what is not leaf-coloured counts against a mask
    assert area_of(whole, {1: 1.0}, colored=half_green) == area_of(whole, {1: 1.0}) / 2
    assert area_of(whole, {1: 1.0}, colored=torch.zeros(4)) == 0


def test_the_whole_plant_as_one_leaf_wins_nowhere() -> None:
    """As on a real muskmelon at 50 px, and on a croton, with a piece of the wall: all views agree."""
    right, blob = Rating(1.1e6, 157.0, 9), Rating(4.3e6, 20.0, 1)
    assert order_ratings([right, blob]) == [0]
    assert order_ratings([blob, right]) == [1]
    assert order_ratings([right, Rating(9.6e6, 37.0, 4)]) == [0]  # too few masks
    assert order_ratings([Rating(1.12e6, 60.0, 9), right, Rating(1.14e6, 60.0, 9)]) == [0, 2, 1]  # as large, by chance
    assert order_ratings([right, Rating(1.2e6, 60.0, 5)]) == [1, 0]
    assert order_ratings([Rating(0, 0, 0), Rating(0, 0, 0)]) == [0, 1]
    found = {size: expecting(1.2, size) for size in (566, 400, 283, 200, 141, 100)}
    found |= {size: expecting(4.0, size, leaves=1, expected=6.0) for size in (71, 50, 35)}
    assert choose_size(found.__getitem__, expecting(1.0, agreement=0.5))[0] is found[566]


@pytest.mark.parametrize("size", [None, 300])
def test_looks_that_are_thrown_away_are_not_spoken_of(monkeypatch: pytest.MonkeyPatch, size: int | None) -> None:
    """Where the plant fills the photo, the detector looks again, unless somebody says at which size to look."""
    asked: list[int | None] = []

    def detect(_: object, config: DetectConfig, **__: object) -> Any:
        asked.append(config.image_size)
        warn(Finding("dark_photo", f"at {config.image_size}"))
        return look_of(squares(9), longest=64)

    monkeypatch.setattr("mvseg.pipeline.find_in_photos.detect_scene", detect)
    with warns_of("dark_photo") as noticed:
        find_in_photos(open_photos(load_scene(demo_scene()), RunConfig(detect=DetectConfig(image_size=size))))
    assert asked == ([300] if size else [None, 45, 32])
    assert [each.where for each in noticed if each.code == "dark_photo"] == [f"at {size}"]


@pytest.mark.parametrize(("is_cropped", "near"), [(False, False), (True, False), (False, True)])
def test_a_part_of_many_photos_chooses_the_size(monkeypatch: pytest.MonkeyPatch, is_cropped: bool, near: bool) -> None:
    """All of them are seen once, at the size that won, in boxes of their own; or twice, where two are nearly equal."""
    asked: list[tuple[int, int | None, int | None]] = []

    def detect(photos: Any, config: DetectConfig, *, boxes: torch.Tensor | None, **_: object) -> Any:
        sizes = photos.scene.cameras.sizes
        asked.append((len(sizes), config.image_size, None if boxes is None else len(boxes)))
        side = 10 if not near else 51 if len(sizes) < 9 else 54  # less a rim of two pixels of the detector
        masks = squares(len(sizes), side={None: 20, 45: 40, 32: side}[config.image_size])
        frames = torch.cat((torch.zeros_like(sizes), sizes), 1)
        return replace(look_of(masks, longest=config.image_size or 64), boxes=frames if is_cropped else None)

    monkeypatch.setattr("mvseg.pipeline.find_in_photos.detect_scene", detect)
    monkeypatch.setattr("mvseg.pipeline.find_in_photos.DETECTION", replace(DETECTION, judging_views=4))
    known = find_in_photos(open_photos(load_scene(demo_scene())))
    last = [(9, 32, 9)] if near else []
    assert asked == [(4, None, None), (4, 45, 4), (4, 32, 4), (9, 45, 9), *last]  # the parts are chosen once
    assert (known.masks.regions.num_views, known.image_size) == (9, 32 if near else 45)
