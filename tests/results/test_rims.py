"""Rims in the photos: two horizontal leaves, one above the other, seen from straight above and from below."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from known_leaves import bent_blade, flat_leaf, move, turn_about
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.rims import Rims, visible_rims
from mvseg.scene import Cameras

SIZE, FOCAL, DISTANCE = 400, 800.0, 200.0


def above_and_below() -> Cameras:
    """Looking along -z and along +z, both at the origin."""
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    down = torch.diag(torch.tensor([1.0, -1, -1]))
    return Cameras(
        K=K.repeat(2, 1, 1),
        R=torch.stack([down, torch.eye(3)]),
        t=torch.tensor([[0, 0, DISTANCE]] * 2),
        sizes=torch.tensor([[SIZE, SIZE]] * 2),
    )


CAMERAS = above_and_below()
LOW = flat_leaf(length=60, half_width=12, at=(-30, 0, 0))
HIGH = flat_leaf(length=20, half_width=10, at=(-10, 12, 30))  # above a part of the other one's edge, y > 0


def points_of(rims: Rims, instance: int) -> np.ndarray:
    return np.concatenate(rims[instance])


def test_a_free_rim_is_one_closed_line() -> None:
    for view, rims in enumerate(visible_rims({7: LOW}, CAMERAS)):
        (line,) = rims[7]
        expected = CAMERAS.project(LOW.rim)[0][view].numpy()
        np.testing.assert_allclose(line, np.concatenate((expected, expected[:1])))


def test_the_nearer_leaf_hides_a_part_of_the_other() -> None:
    above, below = visible_rims({1: LOW, 2: HIGH}, CAMERAS)
    whole = visible_rims({1: LOW}, CAMERAS)[0][1][0]
    assert len(below[1]) == len(above[2]) == 1
    assert len(below[2][0]) < len(above[2][0])  # the high one is hidden from below
    (seen,) = above[1]
    # What is missing of the low one is what the high one's projection covers.
    covered = HIGH.project(CAMERAS)[0].numpy()
    column, row = np.floor(whole[:-1]).astype(int).T
    is_seen = np.array([(np.abs(seen - point).max(1) < 1e-9).any() for point in whole[:-1]])
    assert (is_seen == ~covered[row, column]).mean() > 0.97
    assert 0.1 < is_seen.mean() < 0.95


def test_a_leaf_that_bends_over_hides_its_own_base() -> None:
    """Bent by 170 degrees, with its two halves above each other; from above the tip's half is hidden."""
    blade = move(bent_blade(length=60, bend_deg=170, half_width=6), np.eye(3), shift=(0, 0, 10))
    above = visible_rims({1: blade}, CAMERAS)[0][1]
    assert all(len(line) < len(blade.rim) for line in above)
    heights = blade.rim[:, 2].numpy()
    px = CAMERAS.project(blade.rim)[0][0].numpy()
    seen = np.array([any((np.abs(line - point).max(1) < 1e-9).any() for line in above) for point in px])
    assert seen[heights > np.median(heights) + 5].all()
    assert not seen[heights < heights.min() + 5].any()


def test_ids_may_be_permuted_and_the_world_turned() -> None:
    turn, shift = turn_about(np.array([1.0, 2, 3]), 40), torch.tensor([5.0, -3, 8]).double()
    R = CAMERAS.R @ torch.from_numpy(turn).T
    moved = replace(CAMERAS, R=R, t=CAMERAS.t - (R @ shift))
    leaves = {4: move(HIGH, turn, shift=tuple(shift.tolist())), 9: move(LOW, turn, shift=tuple(shift.tolist()))}
    for rims, again in zip(visible_rims({1: LOW, 2: HIGH}, CAMERAS), visible_rims(leaves, moved), strict=True):
        for instance, other in ((1, 9), (2, 4)):
            first, second = points_of(rims, instance), points_of(again, other)
            assert abs(len(first) - len(second)) <= 2
            assert np.abs(first[:, None] - second).max(2).min(1).max() < 3


def test_what_is_not_credible_is_not_drawn_and_hides_nothing() -> None:
    doubtful = replace(HIGH, iou=torch.full_like(HIGH.iou, 0.1))
    none = LeafSurface.none(torch.arange(2), "for the test")
    for rims in visible_rims({1: LOW, 2: doubtful, 3: none}, CAMERAS):
        assert rims.keys() == {1}
        assert len(points_of(rims, 1)) == len(LOW.rim) + 1
    assert visible_rims({3: none}, CAMERAS) == visible_rims({}, CAMERAS) == [{}, {}]


@pytest.mark.parametrize("height", [DISTANCE + 50, DISTANCE])
def test_a_leaf_behind_a_camera_or_at_it_is_left_out(height: float) -> None:
    behind = flat_leaf(at=(-20, 50, height))
    above, below = visible_rims({1: behind, 2: LOW}, CAMERAS)
    assert above.keys() == {2}
    assert len(points_of(above, 2)) == len(LOW.rim) + 1
    assert below.keys() == {1, 2}
