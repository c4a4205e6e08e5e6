"""Crops do what full-size masks do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.crop import Crop

SIZE = (30, 20)


def some_mask(seed: int) -> torch.Tensor:
    """A frame with a mask somewhere."""
    rng = np.random.default_rng(seed)
    x, y, width, height = rng.integers(0, 15), rng.integers(0, 10), rng.integers(1, 15), rng.integers(1, 10)
    mask = np.zeros(SIZE[::-1], bool)
    mask[y : y + height, x : x + width] = rng.random((height, width)) < 0.6
    mask[y, x] = True
    return torch.from_numpy(mask)


@pytest.mark.parametrize("seed", range(8))
def test_crops_agree_with_full_frames(seed: int) -> None:
    first, second = some_mask(seed), some_mask(seed + 100)
    one, other = Crop.of(first), Crop.of(second.numpy())
    assert torch.equal(one.paste(SIZE), first)
    assert one.area == int(first.sum())
    assert torch.equal(one.cut(first), one.pixels)
    assert all(one.holds(x, y) == bool(first[y, x]) for x in range(SIZE[0]) for y in range(SIZE[1]))
    assert not one.holds(-1, 3)
    assert torch.equal(one.union(other).paste(SIZE), first | second)
    assert torch.equal(one.intersect(other).paste(SIZE), first & second)
    assert one.iou(other) == int((first & second).sum()) / int((first | second).sum())
    box = (5, 3, 22, 14)
    assert torch.equal(one.within(box).pixels, first[3:14, 5:22])
    assert torch.equal(one.within((-4, -2, 40, 30)).pixels[2:22, 4:34], first)


@pytest.mark.parametrize("seed", range(8))
def test_laws(seed: int) -> None:
    one, other = Crop.of(some_mask(seed)), Crop.of(some_mask(seed + 50))
    assert one.union(other).box == other.union(one).box
    assert torch.equal(one.union(other).pixels, other.union(one).pixels)
    assert one.iou(one) == 1
    assert one.iou(other) == other.iou(one) <= one.intersect(other).area / min(one.area, other.area)
    again = Crop.of(one.paste(SIZE))
    assert again.box == one.box
    assert torch.equal(again.pixels, one.pixels)
    wide = one.within((-3, -3, 33, 23))
    assert wide.tighten().box == wide.tighten().tighten().box == one.box
    moved = Crop.of(one.pixels, (one.box[0] + 7, one.box[1] - 2))
    assert moved.box == tuple(np.array(one.box) + (7, -2, 7, -2))


def test_crops_far_apart_share_nothing() -> None:
    one, other = Crop((0, 0, 2, 2), torch.ones(2, 2, dtype=torch.bool)), Crop((9, 0, 10, 1), torch.ones(1, 1).bool())
    assert one.iou(other) == one.intersect(other).area == 0
    assert one.union(other).area == 5
    nothing = Crop((0, 0, 2, 2), torch.zeros(2, 2, dtype=torch.bool))
    assert nothing.iou(one) == nothing.iou(nothing) == 0
