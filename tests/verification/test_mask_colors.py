"""Colours of masks against those of clear leaves, by a slow twin; and what they decide."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from blade_scene import as_regions
from mvseg.masks import Masks, Origin
from mvseg.verification.choose import Judges, choose_leaves
from mvseg.verification.evidence import Drawn, draw_views
from mvseg.verification.mask_colors import MaskColors
from mvseg.verification.numbers import COLORS
from three_leaves import CAMERAS, LEAVES, true_maps

REGIONS, IDS = as_regions(true_maps())
PALETTE = np.array([[120, 120, 120], [30, 120, 40], [20, 80, 26], [200, 60, 30]], np.uint8)


def paint(view: int, colors: dict[int, int]) -> np.ndarray:
    """A photo whose leaves have colours of the palette, on grey."""
    width, height = CAMERAS.sizes[view].tolist()
    photo = np.tile(PALETTE[0], (height, width, 1))
    for row in (REGIONS.view_index == view).nonzero()[:, 0].tolist():
        photo[REGIONS.mask(row, width, height).numpy()] = PALETTE[colors[int(IDS[row])]]
    return photo


def draw(colors: dict[int, int]) -> tuple[Drawn, ...]:
    return draw_views(REGIONS, (), CAMERAS, photos=lambda view: paint(view, colors))


def test_the_same_as_pixel_by_pixel() -> None:
    colors = {1: 1, 2: 2, 3: 3}
    drawn, rng = draw(colors), np.random.default_rng(0)
    weights, is_clear = rng.random((len(REGIONS), 4)), np.array([True, True, False, True])
    counted = MaskColors.of(drawn)
    assert counted is not None
    shares = np.zeros((4, COLORS.hues, COLORS.hues))
    for view, each in enumerate(drawn):
        lab = cv2.cvtColor(paint(view, colors), cv2.COLOR_RGB2LAB).reshape(-1, 3) // (256 // COLORS.hues)
        for place, row in enumerate(each.rows.tolist()):
            for _, a, b in lab[each.masks[:, [place]].toarray()[:, 0] > 0]:
                shares[:, a, b] += weights[row]
    shares = np.stack([gaussian_filter(each, COLORS.blur) for each in shares])
    shares /= shares.sum((1, 2), keepdims=True)
    others = [[other for other in (0, 1, 3) if other != each] for each in range(4)]
    alike = [np.median([np.sqrt(shares[k] * shares[j]).sum() for j in others[k]]) for k in range(4)]
    expected = np.log(alike) - np.median(np.log(alike)[is_clear])
    np.testing.assert_allclose(counted.likeness(weights, is_clear), expected, atol=1e-9)
    np.testing.assert_allclose(counted.likeness(weights[:, ::-1], is_clear[::-1]), expected[::-1], atol=1e-9)
    assert not counted.likeness(weights, np.arange(4) == 1).any()
    assert MaskColors.of(draw_views(REGIONS, (), CAMERAS)) is MaskColors.of(()) is None


def test_what_has_other_colors_than_clear_leaves_is_less_likely_a_leaf(monkeypatch: pytest.MonkeyPatch) -> None:
    """A red leaf among green ones, even if it is clear otherwise; in the shade it stays one, and all may be red."""
    monkeypatch.setattr("mvseg.verification.choose.fit_roughly", lambda *_: LEAVES)
    masks = Masks.of(REGIONS, detection_scores=torch.where(IDS == 3, 0.5, 0.9), origin=Origin.DETECTED)
    masks = replace(masks, instance_ids=IDS, match_scores=0.9 + 0 * IDS, proposal=torch.arange(len(IDS)))

    def chance(*colors: int) -> float:
        judges = Judges(CAMERAS, photos=lambda view: paint(view, dict(enumerate(colors, 1))), min_probability=0.0)
        leaves = choose_leaves(masks, {"matched": masks}, judges)
        ids, proposal = leaves.masks.instance_ids, leaves.masks.proposal
        return leaves.probabilities[int(ids[IDS[proposal] == 3].mode().values)]

    assert chance(3, 3, 3) == pytest.approx(chance(1, 1, 1), abs=1e-6)
    assert min(chance(1, 1, 1), chance(1, 1, 2)) > 0.5
    assert chance(1, 1, 3) < 0.1
