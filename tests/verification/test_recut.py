"""A mask between two others: laws, and edges whose place is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.special import logit

from blade_scene import SIZE, as_regions
from mvseg.masks import Masks, Origin
from mvseg.verification.recut import blur_px, recut, recut_masks
from three_leaves import CAMERAS, LEAVES, true_maps


def half_plane(first_column: int, size: int = 120) -> np.ndarray:
    return np.broadcast_to(np.arange(size) >= first_column, (size, size)).copy()


def blob(seed: int, size: int = 90) -> np.ndarray:
    return gaussian_filter(np.random.default_rng(seed).standard_normal((size, size)), 9) > 0.005


def recut_reference(found: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Pixel by pixel, with the Gaussian written out."""
    odds = np.zeros(found.shape)
    for mask in (found, shown):
        sigma, rows, columns = blur_px(mask), *np.indices(mask.shape)
        for y, x in np.ndindex(mask.shape):
            weight = np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * sigma**2))
            inside = (weight * mask).sum() / weight.sum()
            odds[y, x] += np.clip(logit(inside), -4, 4)
    return (found & shown) | ((found | shown) & (odds > 0))


def test_it_is_what_its_formula_says() -> None:
    found, shown = (np.pad(blob(seed, 34), 8) for seed in (0, 1))
    inner = np.s_[8:-8, 8:-8]  # at the edge of the frame the two blurs differ
    differ = recut(found, shown)[inner] != recut_reference(found, shown)[inner]
    assert differ.mean() < 0.005
    assert (found ^ shown)[inner].mean() > 0.05


@pytest.mark.parametrize("seed", range(3))
def test_laws(seed: int) -> None:
    found, shown = blob(seed), blob(seed + 10)
    new = recut(found, shown)
    assert np.array_equal(recut(found, found), found)
    assert np.array_equal(recut(shown, found), new)
    assert np.array_equal(recut(found.T.copy(), shown.T.copy()), new.T)
    assert np.array_equal(recut(found[:, ::-1].copy(), shown[:, ::-1].copy()), new[:, ::-1])
    assert (new >= (found & shown)).all()
    assert (new <= (found | shown)).all()
    assert (new != found).any()
    assert (new != shown).any()


def test_an_edge_comes_to_lie_between_both() -> None:
    new = recut(half_plane(60), half_plane(64))
    assert np.array_equal(new, half_plane(62))


def test_a_piece_of_the_neighbour_goes_and_a_far_part_of_the_surface_is_not_added() -> None:
    leaf = np.zeros((120, 120), bool)
    leaf[40:80, 20:60] = True
    with_piece = leaf.copy()
    with_piece[50:70, 60:90] = True
    for new in (recut(with_piece, leaf), recut(leaf, with_piece)):
        assert not new[:, 64:].any()
        assert np.array_equal(new[:, :60], leaf[:, :60])


def test_found_masks_are_cut_and_all_others_stay() -> None:
    maps = true_maps()
    piece = maps[0].copy()
    rows, columns = np.nonzero(maps[0] == 1)
    piece[rows.min() : rows.max(), columns.max() : columns.max() + 4] = 1  # what is no leaf sticks to leaf 1
    maps[0] = np.where(maps[0] == 0, piece, maps[0])
    maps[3][maps[3] == 2] = 0
    maps[3][5:25, 5:25] = 2  # what its surface does not agree with
    regions, ids = as_regions(maps)
    cut = recut_masks(Masks.of(regions, ids, origin=Origin.DETECTED), LEAVES, cameras=CAMERAS).regions
    shown = [cut.label_map(view, ids, (SIZE, SIZE)).numpy() for view in range(len(CAMERAS))]
    true = true_maps()
    assert ((maps[0] == 1) ^ (true[0] == 1)).sum() > 20
    assert ((shown[0] == 1) ^ (true[0] == 1)).sum() < 0.3 * ((maps[0] == 1) ^ (true[0] == 1)).sum()
    assert all(np.array_equal(shown[view], maps[view]) for view in range(1, len(CAMERAS)))
    as_it_was = recut_masks(Masks.of(regions, ids, origin=Origin.OTHER_VIEWS), LEAVES, cameras=CAMERAS).regions
    assert torch.equal(as_it_was.boxes, regions.boxes)
    assert torch.equal(as_it_was.pixels()[0], regions.pixels()[0])
