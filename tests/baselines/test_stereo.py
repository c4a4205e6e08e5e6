from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from benchmarks.baselines import stereo
from benchmarks.baselines.stereo import (
    consistent_depth,
    disparity,
    neighbour_pairs,
    rectify,
    seen_ball,
    sgbm_depths,
    smooth,
    view_angles,
)
from leafy_scene import LeafyScene, write_leafy_scene
from mvseg.formats.photos import read_photo
from mvseg.scene import Cameras
from reference import consistent_depth_reference
from synthetic import arc_positions, cameras_at, moved


@pytest.fixture(scope="module")
def leafy(tmp_path_factory: pytest.TempPathFactory) -> LeafyScene:
    return write_leafy_scene(tmp_path_factory.mktemp("leafy"), num_views=3)


def level_arc(num_views: int, step_deg: float) -> Cameras:
    angle = torch.deg2rad(step_deg * torch.arange(num_views).double())
    return cameras_at(10 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1))


def test_depths_of_leaves_are_right(leafy: LeafyScene) -> None:
    photos = [cv2.cvtColor(read_photo(leafy.scene, view), cv2.COLOR_RGB2GRAY) for view in range(3)]
    for view, (depth, true) in enumerate(zip(sgbm_depths(photos, leafy.scene.cameras), leafy.depths, strict=True)):
        labels = leafy.regions.label_map(view, leafy.regions.labels, (320, 320)).numpy()
        inside = cv2.erode((labels > 0).astype(np.uint8), np.ones((5, 5))) > 0
        found = inside & (depth > 0)
        error = np.abs(depth[found] / true[found] - 1)
        assert found.sum() > 0.8 * inside.sum()
        assert np.median(error) < 0.005
        assert (error < 0.02).mean() > 0.9


def test_views_far_apart_have_no_depth() -> None:
    cameras = level_arc(3, 40)
    photos = [np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8)] * 3
    assert not any(depth.any() for depth in sgbm_depths(photos, cameras))


def test_ball_is_what_the_cameras_look_at() -> None:
    """Cameras 10 away from the origin; 240 pixels at a focal length of 400 show 120/400 = tan(16.7 degrees)."""
    ball = seen_ball(cameras_at(arc_positions(6)))
    torch.testing.assert_close(ball.center, torch.zeros(3).double(), atol=1e-9, rtol=0)
    assert ball.radius == pytest.approx(stereo.BALL_MARGIN * 10 * np.sin(np.arctan(120 / 400)))


def test_pairs_are_near_neighbours() -> None:
    cameras = level_arc(5, 11)
    assert neighbour_pairs(cameras, seen_ball(cameras)) == [(0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4)]
    angles = view_angles(cameras, seen_ball(cameras))
    assert angles[0, 2].item() == pytest.approx(22)
    assert angles.diagonal().isinf().all()
    cameras = level_arc(5, 26)
    assert neighbour_pairs(cameras, seen_ball(cameras)) == []


@pytest.mark.parametrize("is_turned", [False, True])
def test_rectified_rows_agree_and_disparity_tells_the_depth(is_turned: bool) -> None:
    """For any direction of the baseline: cameras rolled by a quarter turn have it along their columns."""
    cameras = level_arc(2, 10)
    if is_turned:
        roll = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double()
        K = cameras.K.clone()
        K[:, :2, 2] = K[:, :2, 2].flip(1)
        cameras = Cameras(K, roll @ cameras.R, (roll @ cameras.t[:, :, None])[:, :, 0], cameras.sizes.flip(1))
    ball = seen_ball(cameras)
    pair = rectify(cameras, ball, (0, 1))
    assert pair is not None
    points = ball.radius / 2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double().clamp(-1, 1)
    pixels, depth = cameras.project(points)
    rect = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ pair.rect_from_px.mT
    xy = rect[..., :2] / rect[..., 2:]
    torch.testing.assert_close(xy[0, :, 1], xy[1, :, 1])
    assert ((xy > 0) & (xy < torch.tensor(pair.size))).all()
    shift = xy[0, :, 0] - xy[1, :, 0]
    assert pair.search[0] <= shift.min()
    assert shift.max() <= pair.search[1]
    for view in range(2):
        torch.testing.assert_close(pair.focal_baseline / (shift + pair.offset) / rect[view, :, 2], depth[view])


def test_no_pair_along_the_line_of_sight_or_without_baseline() -> None:
    towards = cameras_at(torch.tensor([[10.0, 0, 0], [8.0, 0.1, 0], [10.0, 0, 0]]))
    ball = seen_ball(cameras_at(arc_positions(4)))
    assert rectify(towards, ball, (0, 1)) is None
    assert rectify(towards, ball, (0, 2)) is None


def test_disparity_of_a_shifted_image() -> None:
    left = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 160), np.uint8), (0, 0), 1.0)
    found = disparity(left, np.roll(left, -7, 1), (-16, 15))
    assert np.abs(found[10:-10, 40:-40] - 7).max() < 0.2


def test_consistent_depth_is_that_of_the_slow_twin() -> None:
    places = 10 * torch.tensor([[1.0, 0, 0], [0.98, 0.2, 0], [0.95, 0, 0.3]])
    cameras = cameras_at(places, focal=40.0, width=32, height=24)
    rng = np.random.default_rng(0)
    depths = [rng.uniform(9.7, 10.3, (24, 32)).astype(np.float32) for _ in range(3)]
    for depth in depths:
        depth[rng.uniform(size=depth.shape) < 0.2] = np.nan
    fast = consistent_depth(depths, cameras, view=0, others=[1, 2])
    np.testing.assert_array_equal(fast, consistent_depth_reference(depths, cameras, 0, [1, 2], stereo.MAX_DEPTH_ERROR))
    assert 50 < (fast > 0).sum() < 500
    assert not consistent_depth(depths, cameras, view=0, others=[]).any()


def test_smoothing_drops_isolated_pixels() -> None:
    depth = np.zeros((12, 12), np.float32)
    depth[2:8, 2:8], depth[10, 10], depth[4, 4] = 5, 9, 7
    smoothed = smooth(depth)
    assert smoothed[10, 10] == 0
    assert (smoothed[3:7, 3:7] == 5).all()
    assert not smoothed[depth == 0].any()


def test_moved_world_scales_the_depths(leafy: LeafyScene) -> None:
    photos = [cv2.cvtColor(read_photo(leafy.scene, view), cv2.COLOR_RGB2GRAY) for view in range(2)]
    cameras = leafy.scene.cameras[[0, 1]]
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double()).Q
    rotation = rotation * torch.linalg.det(rotation)
    away = moved(cameras, 1000.0, rotation, torch.tensor([5e4, 2e4, -3e4]).double())
    for here, there in zip(sgbm_depths(photos, cameras), sgbm_depths(photos, away), strict=True):
        both = (here > 0) & (there > 0)
        assert both.sum() > 0.98 * (here > 0).sum()
        assert np.mean(np.abs(there[both] / here[both] / 1000 - 1) < 1e-3) > 0.99
