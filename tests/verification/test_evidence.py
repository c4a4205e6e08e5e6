"""What a view shows of surfaces and masks, against whole frames drawn the plain way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from blade_scene import SIZE, as_regions
from known_leaves import flat_leaf
from mvseg.verification import evidence
from mvseg.verification.evidence import draw_views, paint_view, see, see_instances
from mvseg.verification.numbers import EVIDENCE
from three_leaves import CAMERAS, LEAVES, true_maps

MAPS = true_maps()
REGIONS, _ = as_regions(MAPS)
SURFACES = [LEAVES[1], None, LEAVES[2], LEAVES[3]]


def frames(hides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(V, K, H, W) what each surface covers, and what of that no nearer one of `hides` covers."""
    covered, seen = np.zeros((2, len(CAMERAS), 4, SIZE, SIZE), bool)
    for view in range(len(CAMERAS)):
        depth = {k: float(CAMERAS[[view]].project(s.points().reshape(-1, 3).mean(0, keepdim=True))[1][0, 0])
                 for k, s in enumerate(SURFACES) if s is not None}  # fmt: skip
        for k, surface in enumerate(SURFACES):
            if surface is not None:
                covered[view, k] = surface.project(CAMERAS[[view]])[0].numpy()
                nearer = [SURFACES[other].project(CAMERAS[[view]])[0].numpy() for other in depth
                          if hides[other] and depth[other] < depth[k]]  # fmt: skip
                seen[view, k] = covered[view, k] & ~np.any([*nearer, np.zeros((SIZE, SIZE), bool)], 0)
    return covered, seen


@pytest.mark.parametrize("hides", [np.zeros(4, bool), np.array([True, False, True, True])])
def test_the_same_as_whole_frames(hides: np.ndarray) -> None:
    found = see(draw_views(REGIONS, SURFACES, CAMERAS), len(REGIONS), hides)
    covered, seen = frames(hides)
    for row in range(0, len(REGIONS), 2):
        view, mask = int(REGIONS.view_index[row]), REGIONS.mask(row, SIZE, SIZE).numpy()
        for k in range(4):
            with_seen = (mask & seen[view, k]).sum()
            either = mask.sum() + seen[view, k].sum() - with_seen
            assert found.visible[row, k] == pytest.approx(with_seen / either)
            assert found.claimed[row, k] == pytest.approx((mask & covered[view, k]).sum() / either)
    share = seen.sum((2, 3)) / np.maximum(covered.sum((2, 3)), 1)
    np.testing.assert_allclose(found.share, share)


def test_large_photos_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = see(draw_views(REGIONS, SURFACES, CAMERAS), len(REGIONS), np.ones(4, bool))
    monkeypatch.setattr(evidence, "EVIDENCE", replace(EVIDENCE, most_px=SIZE // 3))
    drawn = draw_views(REGIONS, SURFACES, CAMERAS)
    assert drawn[0].masks.shape[0] == len(range(2, SIZE, 4)) ** 2
    thin = see(drawn, len(REGIONS), np.ones(4, bool))
    large = (REGIONS.areas > 400).numpy()
    np.testing.assert_allclose(thin.visible[large], whole.visible[large], atol=0.08)


def test_nothing_to_compare() -> None:
    nothing = see(draw_views(REGIONS, [], CAMERAS), len(REGIONS), np.zeros(0, bool))
    assert nothing.visible.shape == (len(REGIONS), 0)
    empty = REGIONS.select(torch.zeros(0, dtype=torch.int64))
    assert see(draw_views(empty, SURFACES, CAMERAS), 0, np.zeros(4, bool)).share.shape == (len(CAMERAS), 4)


def test_photos_are_painted_with_the_nearest_surface() -> None:
    """Those that are not credible, or not in the photo, are left out."""
    doubtful = replace(LEAVES[1], iou=torch.full_like(LEAVES[1].iou, 0.3))
    beside = flat_leaf(length=1.6, half_width=0.5, at=(50, 0, 0))
    surfaces = {5: LEAVES[1], 7: LEAVES[2], 8: doubtful, 9: beside}
    _, seen = frames(np.array([True, False, True, False]))
    for view in range(len(CAMERAS)):
        painted = paint_view(surfaces, CAMERAS, view)
        np.testing.assert_array_equal(painted == 5, seen[view, 0])
        np.testing.assert_array_equal(painted == 7, seen[view, 2])
        assert set(np.unique(painted).tolist()) <= {0, 5, 7}
    assert not paint_view({}, CAMERAS, 0).any()


def test_columns_are_instance_ids() -> None:
    """A surface that is not credible shows and hides nothing."""
    doubtful = replace(LEAVES[3], iou=torch.full_like(LEAVES[3].iou, 0.3))
    both = see_instances(REGIONS, {4: LEAVES[1], 2: LEAVES[2], 6: doubtful}, CAMERAS)
    expected = see(draw_views(REGIONS, [LEAVES[1], LEAVES[2]], CAMERAS), len(REGIONS), np.array([True, True]))
    np.testing.assert_array_equal(both.visible[:, [4, 2]], expected.visible)
    np.testing.assert_array_equal(both.share[:, [4, 2]], expected.share)
    assert not both.visible[:, [0, 1, 3, 5, 6]].any()
