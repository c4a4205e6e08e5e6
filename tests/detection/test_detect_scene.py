"""A second look at half the size, where few masks are surely matched."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from found_masks import FoundMasks
from mvseg import demo_scene, load_scene
from mvseg.detection import detect_scene as steps
from mvseg.detection.config import DetectConfig
from mvseg.detection.find_leaves import find_leaves
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport


def found(*, side: int, scores: list[float]) -> Masks:
    """A square in each of as many views as there are scores, all of one instance."""
    labels = np.zeros((120, 120), np.int64)
    labels[:side, :side] = 1
    regions, _ = as_regions([labels] * len(scores))
    return Masks.of(regions, torch.ones(len(scores), dtype=torch.int64), torch.tensor(scores))


def seen(masks: Masks, max_size: int) -> SimpleNamespace:
    """A look of a detector that scales to so many pixels."""
    look = FoundMasks(Matching(masks, MatchReport("none")), masks)
    object.__setattr__(look, "model", SimpleNamespace(transform=SimpleNamespace(max_size=max_size)))
    return SimpleNamespace(look=look, cached=None, names=set())


def test_both_sizes_count_where_masks_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is proposed at half the size follows, and the labels of all matchings are rows of the whole set."""
    scene = load_scene(demo_scene())
    views, sides = len(scene.views), (100, 50)
    tables = [found(side=side, scores=[0.1] * views) for side in sides]
    tables = [replace(each, regions=replace(each.regions, labels=torch.arange(views))) for each in tables]

    def see(_: Photos, config: DetectConfig, **__: object) -> SimpleNamespace:
        return seen(tables[config.image_size is not None], int(scene.cameras.sizes.max()))

    monkeypatch.setattr(steps, "_see", see)
    both = find_leaves(steps.detect_scene(Photos(scene)), scene.cameras)
    assert len(both.proposals) == 2 * views
    assert [*map(steps.median_side, tables)] == [*sides]
    assert [each.regions.labels.min() for each in both.matched] == [0, 0, views, views]
    for each in both.matched:
        assert torch.equal(each.regions.areas, both.proposals.regions.areas[each.regions.labels])
    assert len(steps.detect_scene(Photos(scene), DetectConfig(verify=False))) == 1
    monkeypatch.setattr(steps, "LARGE", 101.0)
    assert len(steps.detect_scene(Photos(scene))) == 1


def test_the_share_and_the_area_of_sure_masks() -> None:
    masks = found(side=10, scores=[0.95, 0.9, 0.5, 0.2])
    assert steps.share_of_sure(masks) == 0.5
    assert steps.area_of_sure(masks) == pytest.approx(200)
    unsure = masks.select(torch.tensor([2, 3]))
    assert steps.share_of_sure(unsure) == steps.area_of_sure(unsure) == 0
    assert steps.share_of_sure(masks.select(torch.zeros(0, dtype=torch.int64))) == 0


@pytest.mark.parametrize(
    ("config", "first", "second", "sizes", "chosen"),
    [
        (DetectConfig(crop="off"), [0.95, 0.95], None, [None], 0),  # sure enough
        (DetectConfig(crop="off", image_size=300), [0.1, 0.1], None, [300], 0),  # asked for
        (DetectConfig(crop="off"), [0.95, 0.1, 0.1], [0.95, 0.95], [None, 240], 1),  # more is sure at half the size
        (DetectConfig(crop="off"), [0.95, 0.1, 0.1], [0.1], [None, 240], 0),
    ],
)
def test_half_the_size_where_few_masks_are_sure(
    config: DetectConfig,
    first: list[float],
    second: list[float] | None,
    sizes: list[int | None],
    chosen: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Photos of 640 x 480 before a detector that scales to 480 pixels at most."""
    asked, answers = [], [found(side=10, scores=scores) for scores in (first, second) if scores is not None]

    def see(_: Photos, config: DetectConfig, **__: object) -> SimpleNamespace:
        asked.append(config.image_size)
        return seen(answers[len(asked) - 1], 480)

    monkeypatch.setattr(steps, "_see", see)
    scene = load_scene(demo_scene())
    assert scene.cameras.sizes.max() >= 480
    (look,) = steps.detect_scene(Photos(scene), config)
    assert asked == sizes
    assert look.sure.masks is answers[chosen]
