"""Faults of real photos: what is drawn, and what stays as it was."""

from __future__ import annotations

import torch

from mvseg.training.photo_faults import add_clutter, spoil, tint_leaves


def noisy_photo(height: int = 48, width: int = 64) -> torch.Tensor:
    return torch.randint(0, 256, (3, height, width), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


def test_every_fault_occurs_and_leaves_the_photo_it_was_made_from() -> None:
    torch.manual_seed(0)
    photo = noisy_photo()
    before = photo.clone()
    spoilt = [spoil(photo) for _ in range(60)]
    assert torch.equal(photo, before)
    assert all(image.shape == photo.shape and image.dtype == torch.uint8 for image in spoilt)
    assert not any(torch.equal(image, photo) for image in spoilt)
    colorless = [bool((image == image[:1]).all()) for image in spoilt]
    brighter = [bool((image >= photo).all()) for image in spoilt]
    assert 3 < sum(colorless) < 25
    assert 3 < sum(brighter) < 25


def test_clutter_hides_what_is_behind_it() -> None:
    photo = noisy_photo()
    layers = torch.ones((2, 48, 64), dtype=torch.int32)
    shares = []
    for seed in range(30):
        torch.manual_seed(seed)
        covered, remaining = add_clutter(photo, layers)
        is_hidden = remaining[0] == 0
        assert torch.equal(remaining[0], remaining[1])
        assert bool((layers == 1).all())
        assert torch.equal(covered[:, ~is_hidden], photo[:, ~is_hidden])
        shares.append(float(is_hidden.float().mean()))
    assert 0.005 < sum(shares) / len(shares) < 0.3
    assert max(shares) < 0.6


def test_leaves_get_another_colour_and_all_else_stays() -> None:
    photo = torch.full((3, 20, 30), 60, dtype=torch.uint8)
    photo[1] = 140  # green
    layers = torch.zeros((2, 20, 30), dtype=torch.int32)
    layers[0, :10], layers[1, 5:15, :10] = 1, 2
    is_leaf = (layers > 0).any(0)
    before, ratios = photo.clone(), []
    for seed in range(40):
        torch.manual_seed(seed)
        tinted = tint_leaves(photo, layers)
        assert tinted.dtype == torch.uint8
        assert torch.equal(tinted[:, ~is_leaf], photo[:, ~is_leaf])
        red, green, _ = tinted[:, 0, 20].float()
        ratios.append(float(red / green))
        assert len(tinted[:, :5].flatten(1).unique(dim=1).T) == 1  # a leaf has one colour
    assert torch.equal(photo, before)
    assert min(ratios) < 0.5
    assert max(ratios) > 1.3
    torch.manual_seed(0)
    assert torch.equal(tint_leaves(photo, torch.zeros_like(layers)), photo)
