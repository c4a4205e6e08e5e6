"""Plants rendered while a detector trains, and grey photos that get colours and backgrounds."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.training import augmentation
from mvseg.training.augmentation import AugmentedSamples
from mvseg.training.config import TrainConfig
from mvseg.training.data import SampleList
from mvseg.training.new_plants import draw_background, list_backgrounds, recolor, render_new_plant


@pytest.fixture
def backgrounds(tmp_path: Path) -> tuple[Path, ...]:
    blue = np.full((40, 60, 3), (255, 0, 0), np.uint8)
    cv2.imwrite(str(tmp_path / "blue.png"), blue)
    return list_backgrounds(tmp_path)


rendered = cache(lambda seed: render_new_plant(seed, 64))


def test_a_seed_gives_one_photo_and_another_seed_another() -> None:
    once, again, other = rendered(5), render_new_plant(5, 64), rendered(2)
    assert torch.equal(once.photo, again.photo)
    assert torch.equal(once.layers, again.layers)
    assert not torch.equal(once.photo, other.photo)


def test_backgrounds_are_seen_behind_some_plants_and_never_on_a_leaf(backgrounds: tuple[Path, ...]) -> None:
    blue = torch.tensor([0, 0, 255], dtype=torch.uint8)[:, None, None]
    num_seen = 0
    for seed in (2, 5):
        before, after = render_new_plant(seed, 64, backgrounds), rendered(seed)
        is_blue = (before.photo == blue).all(0)
        num_seen += bool(is_blue.any())
        assert not (is_blue & (before.layers[0] > 0)).any()
        assert not (after.photo == blue).all(0).any()
    assert num_seen == 1


def test_an_epoch_ends_with_new_plants_and_the_next_one_has_others(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(augmentation, "render_new_plant", lambda seed, *_: seeds.append(seed) or rendered(5))
    config = TrainConfig(output=Path("out"), from_results=Path("results"), image_size=64, seed=1, new_plants=2)
    samples = AugmentedSamples(SampleList((), ("leaf",)), config)
    assert len(samples) == 2
    (photo, target, index), _ = samples[0, 1], samples[1, 1]
    assert photo.shape == (3, 64, 64)
    assert index == 1
    assert len(target["boxes"])
    assert len({*seeds}) == len(seeds) == 2


def test_grey_leaves_get_a_colour_and_stand_on_the_background(backgrounds: tuple[Path, ...]) -> None:
    grey = torch.full((3, 30, 30), 90, dtype=torch.uint8)
    layers = torch.zeros((1, 30, 30), dtype=torch.int32)
    layers[0, 10:20, 10:20] = 1
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        behind = draw_background(backgrounds, grey)
        colored = recolor(grey, layers, behind)
    assert behind.shape == grey.shape
    assert colored.dtype == torch.uint8
    assert torch.equal(colored[:, :9], behind[:, :9])
    red, green, blue = colored[:, 12:18, 12:18].float().mean((1, 2)).tolist()
    assert green > red > 0
    assert green > blue


def test_a_folder_without_photos_is_named(tmp_path: Path) -> None:
    assert list_backgrounds(None) == ()
    with pytest.raises(InputError, match=r"backgrounds is .*, expected a folder of photos"):
        list_backgrounds(tmp_path)
