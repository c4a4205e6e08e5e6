"""Augmented samples: photo and masks move together, targets fit their masks, and everything follows from the seed."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mvseg.evaluation.labelled_photo import LabelledPhoto
from mvseg.training.augmentation import MEAN_COLOR, AugmentedSamples, augment, make_target, order_epoch
from mvseg.training.config import TrainConfig
from mvseg.training.data import list_samples
from tiny_training import write_photos

CONFIG = TrainConfig(output=Path("out"), from_results=Path("results"), image_size=64)
PLAIN = replace(CONFIG, orientation="fixed", scale_range=(1.0, 1.0), color_jitter=0.0, blur_probability=0.0)


def make_sample(height: int = 48, width: int = 64) -> LabelledPhoto:
    """Two rectangles in pure red and green on black."""
    layer = torch.zeros((height, width), dtype=torch.int32)
    layer[5:25, 10:40] = 1
    layer[28:40, 30:60] = 2
    photo = torch.stack([layer == 1, layer == 2, layer < 0]).to(torch.uint8) * 255
    return LabelledPhoto(
        photo=photo,
        layers=layer[None],
        classes=torch.tensor([1, 2]),
        ignore=torch.zeros((height, width), dtype=torch.bool),
    )


def mask_from_photo(photo: Tensor, channel: int) -> Tensor:
    """Where the photo shows the rectangle; the frame around the photo has almost equal channels."""
    return (photo[channel] - photo[2] > 0.5) & (photo[channel] - photo[1 - channel] > 0)


def overlap(a: Tensor, b: Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("orientation", ["any", "upright", "fixed"])
@pytest.mark.parametrize("scale_range", [(1.0, 1.0), (0.4, 0.9), (1.1, 2.0)])
def test_masks_follow_the_photo(orientation: Any, scale_range: tuple[float, float]) -> None:
    for seed in range(8):
        config = replace(PLAIN, orientation=orientation, scale_range=scale_range)
        photo, target = augment(make_sample(), config, seed)
        assert photo.shape == (3, 64, 64)
        for label, mask in zip(target["labels"].tolist(), target["masks"].bool(), strict=True):
            assert overlap(mask_from_photo(photo, label - 1), mask) > 0.85


def test_orientations() -> None:
    """Corners of the red rectangle: which of the eight orientations of a square do occur."""
    sample = make_sample(64, 64)
    seen = {
        orientation: {
            tuple(augment(sample, replace(PLAIN, orientation=orientation), seed)[1]["boxes"][0].tolist())
            for seed in range(60)
        }
        for orientation in ("any", "upright", "fixed")
    }
    assert [len(boxes) for boxes in seen.values()] == [8, 2, 1]
    assert seen["upright"] == {(10.0, 5.0, 40.0, 25.0), (24.0, 5.0, 54.0, 25.0)}


def test_resizing_does_not_shift_masks() -> None:
    """The centroid of a disc scales with the photo; plain nearest would be off by 0.4 px."""
    rows, columns = torch.meshgrid(torch.arange(256), torch.arange(256), indexing="ij")
    layer = ((rows + 0.5 - 120) ** 2 + (columns + 0.5 - 140) ** 2 < 60**2).to(torch.int32)
    photo = torch.zeros((3, 256, 256), dtype=torch.uint8)
    labelled = LabelledPhoto(
        photo=photo, layers=layer[None], classes=torch.tensor([1]), ignore=torch.zeros_like(layer, dtype=torch.bool)
    )
    mask = augment(labelled, PLAIN, 0)[1]["masks"][0]
    centroid = (mask.nonzero().float() + 0.5).mean(0)
    assert centroid.tolist() == pytest.approx([120 / 4, 140 / 4], abs=0.2)


def test_ignored_pixels_and_the_frame_have_the_mean_colour() -> None:
    sample = make_sample()
    sample.ignore[:, 10:40] = True
    photo, _ = augment(sample, PLAIN, 1)
    mean = torch.tensor(MEAN_COLOR) / 255
    is_mean = (photo - mean[:, None, None]).abs().amax(0) < 1e-6
    assert int(is_mean.sum()) == 16 * 64 + 48 * 30  # 64 x 48 photo in a 64 x 64 frame
    assert int(sample.photo[0].max()) == 255  # the sample itself is not painted over


@pytest.mark.parametrize("change", ["color_jitter", "blur_probability", "light_probability", "fault_probability"])
def test_colour_blur_light_and_faults_change_the_photo_only(change: str) -> None:
    expected = augment(make_sample(), PLAIN, 3)
    photo, target = augment(make_sample(), replace(PLAIN, **{change: 1.0}), 3)
    assert not torch.equal(photo, expected[0])
    assert torch.equal(target["masks"], expected[1]["masks"])
    assert 0 <= float(photo.min()) <= float(photo.max()) <= 1


def test_targets_of_instances_and_of_none() -> None:
    layers = torch.zeros((2, 10, 12), dtype=torch.int32)
    layers[0, 2:5, 3:9] = 1
    layers[0, 8, :4] = 2
    layers[1, 1:9, 4:7] = 3
    target = make_target(layers, torch.tensor([5, 6, 7]), min_pixels=5)
    assert target["labels"].tolist() == [5, 7]  # instance 2 has four pixels
    assert target["boxes"].tolist() == [[3, 2, 9, 5], [4, 1, 7, 9]]  # half-open
    assert (target["boxes"].dtype, target["masks"].dtype) == (torch.float32, torch.uint8)
    assert target["masks"].sum((1, 2)).tolist() == [18, 24]
    target = make_target(torch.zeros((1, 4, 5), dtype=torch.int32), torch.zeros(0, dtype=torch.int64))
    assert {key: tuple(value.shape) for key, value in target.items()} == {
        "boxes": (0, 4), "labels": (0,), "masks": (0, 4, 5)}  # fmt: skip


def test_samples_follow_from_seed_epoch_and_index(tmp_path: Path) -> None:
    samples = list_samples(*write_photos(tmp_path, 3))
    ours, again, other = (AugmentedSamples(samples, replace(CONFIG, seed=seed)) for seed in (1, 1, 2))
    torch.manual_seed(0)
    expected = torch.rand(2)
    torch.manual_seed(0)
    photo, target, index = ours[4, 2]
    assert torch.equal(torch.rand(2), expected)  # the global generator was not touched
    assert (len(ours), index) == (3, 2)
    same, same_target, _ = again[4, 2]
    assert torch.equal(photo, same)
    assert all(torch.equal(value, same_target[key]) for key, value in target.items())
    for changed in (ours[5, 2], ours[4, 1], other[4, 2]):
        assert not torch.equal(photo, changed[0])


@pytest.mark.parametrize(("num_samples", "batch_size"), [(12, 4), (10, 4), (3, 8), (1, 1)])
def test_order_of_an_epoch(num_samples: int, batch_size: int) -> None:
    batches = order_epoch(num_samples, batch_size, seed=0, epoch=0)
    assert [len(batch) for batch in batches] == [batch_size] * int(np.ceil(num_samples / batch_size))
    counts = Counter(index for batch in batches for index in batch)
    assert set(counts) == set(range(num_samples))
    assert max(counts.values()) - min(counts.values()) <= 1
    assert batches == order_epoch(num_samples, batch_size, seed=0, epoch=0)


def test_epochs_differ() -> None:
    first = order_epoch(20, 4, seed=0, epoch=0)
    assert first != order_epoch(20, 4, seed=0, epoch=1)
    assert first != order_epoch(20, 4, seed=1, epoch=0)
