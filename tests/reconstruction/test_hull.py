from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from blade_scene import SIZE, EllipticBlade, blade_masks, ring_cameras
from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import STACK
from mvseg.reconstruction.surface.hull import carve_hull, locate_points
from mvseg.reconstruction.surface.mask_stack import MaskStack, choose_pixel_size, stack_masks

BLADE = EllipticBlade(bend=0.9)


def stack(num_views: int, *, times: int = 1) -> MaskStack:
    """The blade's masks; `times` as large, by repeating pixels."""
    cameras = ring_cameras(num_views)
    masks = [mask.repeat(times, 0).repeat(times, 1) for mask in blade_masks(BLADE, cameras)]
    nothing = [np.zeros(mask.shape, np.int32) for mask in masks]
    matrices = cameras.px_from_world.numpy() * np.array([[times], [times], [1]])
    return stack_masks(masks, nothing, range(num_views), px_from_world=matrices)


def votes_reference(points: Floats, num_views: int) -> np.ndarray:
    """(P,) in how many masks points lie, from the full photos."""
    cameras = ring_cameras(num_views)
    votes = np.zeros(len(points), int)
    for mask, matrix in zip(blade_masks(BLADE, cameras), cameras.px_from_world.numpy(), strict=True):
        x, y, depth = matrix @ np.append(points, np.ones((len(points), 1)), 1).T
        column, row = (np.floor(each / depth).astype(int) for each in (x, y))
        is_shown = (column >= 0) & (row >= 0) & (column < SIZE) & (row < SIZE)
        votes += is_shown & mask[row.clip(0, SIZE - 1), column.clip(0, SIZE - 1)]
    return votes


@pytest.mark.parametrize("num_views", [2, 5, 10])
def test_hull_is_all_voxels_that_most_masks_show(num_views: int) -> None:
    """Slow twin: a dense lattice about the leaf, looked up in the full photos."""
    hull = carve_hull(stack(num_views))
    middle = np.round((np.zeros(3) - hull.corner) / hull.size).astype(int)
    reach = int(np.ceil(1.6 / hull.size))
    lattice = middle + np.stack(np.meshgrid(*[np.arange(-reach, reach)] * 3, indexing="ij"), -1).reshape(-1, 3)
    votes = votes_reference(hull.corner + hull.size * (lattice + 0.5), num_views)
    here = np.abs(hull.voxels - middle).max(1) < reach
    assert set(map(tuple, hull.voxels[here].tolist())) == set(map(tuple, lattice[2 * votes > num_views].tolist()))
    assert (votes_reference(hull.points[hull.is_seen], num_views) > 0.8 * num_views).all()
    assert len(hull.points) > 1000


def test_what_another_instance_may_hide_is_not_free() -> None:
    masks = stack(3)
    hidden = replace(masks, others=np.where(masks.inside, 0, 7).astype(np.int32))
    points = carve_hull(masks).points
    inside, free = locate_points(masks, points)
    assert (inside | free).all()
    assert not locate_points(hidden, points)[1].any()


def test_a_thin_mask_beside_large_ones_keeps_pixels() -> None:
    """Pixels are made larger for the others: without any, the mask has no middle."""
    masks = [np.zeros((900, 900), bool) for _ in range(3)]
    masks[0][100:800, 100:800] = masks[1][100:800, 100:800] = masks[2][400, 300:600] = True
    nothing = [np.zeros(mask.shape, np.int32) for mask in masks]
    made = stack_masks(masks, nothing, range(3), px_from_world=ring_cameras(3).px_from_world.numpy())
    assert made.pixel_size > 2
    assert made.inside.any((1, 2)).all()
    carve_hull(made)


def test_larger_photos_give_the_same_masks() -> None:
    small, large = stack(4), stack(4, times=5)
    assert small.pixel_size == 1
    assert large.pixel_size > 1
    size = large.pixel_size / 5
    assert np.sqrt(large.inside.sum((1, 2))) * size == pytest.approx(np.sqrt(small.inside.sum((1, 2))), rel=0.02)
    assert np.abs(np.argwhere(large.inside[0]).min(0) - STACK.margin).max() <= 1
    point = np.array([0.1, 0.2, 0.0, 1.0])
    first, second = (masks.px_from_world @ point for masks in (small, large))
    first, second = (px[:, :2] / px[:, 2:] - STACK.margin for px in (first, second))
    assert second * size == pytest.approx(first, abs=0.6)


def test_masks_are_averaged_where_they_are_made_smaller() -> None:
    rng = np.random.default_rng(0)
    mask = cv2.GaussianBlur(rng.random((500, 600)).astype(np.float32), (0, 0), 20) > 0.5
    masks = stack_masks([mask], [np.zeros(mask.shape, np.int32)], [0], px_from_world=np.eye(3, 4)[None])
    k = masks.pixel_size
    assert k == choose_pixel_size([int(mask.sum())], 600) > 1
    left, top = (np.flatnonzero(mask.any(axis))[0] - k * STACK.margin for axis in (0, 1))
    rows, columns = masks.size
    around = 2 * k * STACK.margin
    padded = np.pad(mask, around)[top + around :, left + around :][: rows * k, : columns * k]
    share = np.zeros((rows * k, columns * k))
    share[: padded.shape[0], : padded.shape[1]] = padded
    assert (masks.inside[0] == (share.reshape(rows, k, columns, k).mean((1, 3)) >= 0.5)).all()
