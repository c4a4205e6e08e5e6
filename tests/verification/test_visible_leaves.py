"""Which surfaces a photo shows: against drawing pixel by pixel, and at the edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from blade_scene import SIZE, ring_cameras
from known_leaves import flat_leaf
from mvseg.verification.visible_leaves import VisibleLeaf, visible_leaves

CAMERAS = ring_cameras(4, elevations_deg=(60, 75))
UPPER = flat_leaf(length=1.6, half_width=0.3, at=(-0.8, 0, 0.5))
LOWER = flat_leaf(length=1.6, half_width=0.5, at=(-0.8, 0, 0))


def whole(leaf: VisibleLeaf) -> np.ndarray:
    """Its mask as a full frame."""
    x1, y1, x2, y2 = leaf.box
    frame = np.zeros((SIZE, SIZE), bool)
    frame[y1:y2, x1:x2] = leaf.mask
    return frame


def test_the_nearer_surface_hides_the_other() -> None:
    for view in range(len(CAMERAS)):
        near, far = visible_leaves({5: LOWER, 7: UPPER}, CAMERAS, view)
        upper, lower = (surface.project(CAMERAS)[view].numpy() for surface in (UPPER, LOWER))
        assert (near.instance, far.instance) == (7, 5)
        np.testing.assert_array_equal(whole(near), upper)
        np.testing.assert_array_equal(whole(far), lower & ~upper)
        assert near.share == 1
        assert 0 < far.share == (lower & ~upper).sum() / lower.sum() < 1


def test_what_is_not_credible_or_not_in_the_photo_is_left_out() -> None:
    doubtful = replace(UPPER, iou=torch.full((6,), 0.3, dtype=torch.float64))
    beside = flat_leaf(length=1.6, half_width=0.5, at=(50, 0, 0))
    (only,) = visible_leaves({1: doubtful, 2: LOWER, 3: beside}, CAMERAS, 0)
    assert only.instance == 2
    assert only.share == 1
    np.testing.assert_array_equal(whole(only), LOWER.project(CAMERAS)[0].numpy())
    assert [*visible_leaves({}, CAMERAS, 0)] == []
