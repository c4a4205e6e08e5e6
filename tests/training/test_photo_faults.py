"""Faults of real photos: what is drawn, and what stays as it was."""

from __future__ import annotations

import math

import torch

from mvseg.training.photo_faults import (
    add_clutter,
    blur_motion,
    compress,
    hand_shape,
    light_unevenly,
    spoil,
    tint_leaves,
)


def noisy_photo(height: int = 48, width: int = 64) -> torch.Tensor:
    return torch.randint(0, 256, (3, height, width), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


def test_uneven_light_changes_patches_of_the_photo() -> None:
    torch.manual_seed(0)
    grey = torch.full((3, 40, 30), 100, dtype=torch.uint8)
    changed = [light_unevenly(grey) for _ in range(40)]
    assert all(photo.shape == grey.shape and photo.dtype == torch.uint8 for photo in changed)
    assert all(torch.equal(photo[0], photo[1]) for photo in changed)  # brighter or darker, no other hue
    assert min(int(photo.min()) for photo in changed) < 40
    assert max(int(photo.max()) for photo in changed) > 220
    sharp = [photo for photo in changed if bool(((photo[0] == 100).float().mean() - 0.5).abs() < 0.4)]
    assert sharp  # in some, a part is as it was


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


def test_compression_errs_more_at_a_lower_quality() -> None:
    photo = noisy_photo()
    errors = [(compress(photo, quality=quality).float() - photo).abs().mean() for quality in (100, 50, 10)]
    assert 0 < errors[0] < errors[1] < errors[2]
    red = torch.zeros((3, 16, 16), dtype=torch.uint8)
    red[0] = 200
    assert int((compress(red, quality=60).int() - red).abs().max()) < 12  # channels keep their order


def test_motion_blur_moves_light_along_its_line_only() -> None:
    photo = torch.zeros((3, 21, 21), dtype=torch.uint8)
    photo[:, 10] = 200  # a horizontal line
    along = blur_motion(photo, length=7.0, angle=0.0)
    across = blur_motion(photo, length=7.0, angle=math.pi / 2)
    assert torch.equal(along, photo)
    assert int(across[0, 10, 10]) < 40
    assert int(across[0, 13, 10]) > 20
    assert int(across[0, 15, 10]) == 0
    assert abs(int(across[0, :, 10].sum()) - 200) <= 4  # no light is lost
    turned = blur_motion(photo.mT, length=7.0, angle=math.pi / 2)
    assert torch.equal(turned, along.mT)


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


def test_a_hand_has_four_fingers_and_an_arm() -> None:
    torch.manual_seed(0)
    axis = torch.linspace(-1.5, 1.5, 301)
    hand = hand_shape(axis[None], axis[:, None])
    through_the_fingers = hand[:, 220].int()
    assert int((through_the_fingers.diff() == 1).sum()) == 4
    assert bool(hand[150, 0])  # the arm reaches out of the photo
    assert not bool(hand[150, -1])
    assert 0.05 < float(hand.float().mean()) < 0.3
