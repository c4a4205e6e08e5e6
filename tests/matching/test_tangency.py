"""TangencyResiduals between outlines: 0 on exact scenes, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from matched import matched
from mvseg.masks import Masks
from mvseg.matching.tangency import Outlines, find_outlines, move_cameras, pair_outlines, tangency_residuals
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from synthetic import BallScene, arc_positions, ball_scene, cameras_at


def true_masks(scene: BallScene) -> Masks:
    return matched(scene.regions, scores=1.0).masks


def points_as_outlines(cameras: Cameras, points: torch.Tensor) -> Outlines:
    """Every view sees every cloud of points (K, P, 3), as outlines of instances 1 to K."""
    px = torch.stack([cameras.project(cloud)[0] for cloud in points], 1)
    num_views, num_clouds = px.shape[:2]
    return Outlines(
        corners=px.flatten(0, 1),
        middle=px.flatten(0, 1).mean(1),
        view=torch.arange(num_views).repeat_interleave(num_clouds),
        instance=torch.arange(1, num_clouds + 1).repeat(num_views),
        weight=torch.ones(num_views * num_clouds).double(),
    )


def test_balls_begin_and_end_on_the_same_lines() -> None:
    scene = ball_scene(5, 6, seed=3, radius=0.25)
    outlines = find_outlines(true_masks(scene), scene.cameras)
    pairs = pair_outlines(outlines, scene.cameras)
    residuals = tangency_residuals(outlines, pairs, scene.cameras, world_per_px=torch.ones(6))
    assert len(residuals.px) == 2 * len(pairs) > 100
    assert residuals.px.abs().median() < 0.5  # a pixel's centre is up to half a pixel from the ball's edge


def test_wrong_poses_leave_gaps_of_about_their_error() -> None:
    scene = ball_scene(5, 6, seed=3, radius=0.25)
    outlines = find_outlines(true_masks(scene), scene.cameras)
    steps = torch.from_numpy(np.random.default_rng(0).normal(0, 6, (6, 6)))
    steps[:, 3:] = 0
    turned = move_cameras(scene.cameras, steps, torch.ones(6))
    residuals = tangency_residuals(outlines, pair_outlines(outlines, turned), turned, world_per_px=torch.ones(6))
    assert 2 < residuals.px.abs().median() < 12


def test_derivatives_are_those_of_differences() -> None:
    cameras = cameras_at(arc_positions(4))
    rng = np.random.default_rng(1)
    points = torch.from_numpy(rng.normal(0, 0.3, (3, 1, 3)) + rng.normal(0, 0.2, (3, 8, 3)))
    outlines = points_as_outlines(cameras, points)
    world_per_px = torch.tensor([0.02, 0.03, 0.02, 0.01]).double()
    start = move_cameras(cameras, torch.from_numpy(rng.normal(0, 3, (4, 6))), world_per_px)
    pairs = pair_outlines(outlines, start)
    residuals = tangency_residuals(outlines, pairs, start, world_per_px=world_per_px)
    for view in range(4):
        for axis in range(6):
            sides = []
            for sign in (1, -1):
                steps = torch.zeros(4, 6).double()
                steps[view, axis] = sign * 1e-4
                moved = move_cameras(start, steps, world_per_px)
                sides.append(tangency_residuals(outlines, pairs, moved, world_per_px=world_per_px).px)
            expected = (residuals.by_pose[..., axis] * (outlines.view[residuals.outlines] == view)).sum(1)
            # the residual's own scale changes, too, which Gauss-Newton leaves out: a few per cent of a pixel per pixel
            assert torch.allclose((sides[0] - sides[1]) / 2e-4, expected, atol=0.05)


def test_growth_moves_both_ends_outwards() -> None:
    cameras = cameras_at(arc_positions(2))
    points = torch.from_numpy(np.random.default_rng(2).normal(0, 0.3, (1, 20, 3)))
    outlines = points_as_outlines(cameras, points)
    pairs = torch.tensor([[0, 1]])
    residuals = tangency_residuals(outlines, pairs, cameras, world_per_px=torch.ones(2))
    away = outlines.corners[0] - outlines.middle[0]
    corners = outlines.corners.clone()
    corners[0] += 0.1 * away / away.norm(dim=1, keepdim=True)
    grown = Outlines(corners, outlines.middle, outlines.view, outlines.instance, outlines.weight)
    change = tangency_residuals(grown, pairs, cameras, world_per_px=torch.ones(2)).px - residuals.px
    assert (change.sign() == residuals.by_growth[:, 0].sign()).all()
    assert (residuals.by_growth.abs() <= 1).all()


def test_masks_that_end_elsewhere_are_left_out() -> None:
    labels = np.zeros((2, 60, 80), np.int64)
    labels[:, 20:30, 20:30] = 1
    labels[0, 40:50, 0:9] = 2  # cut by the border
    labels[1, 40:50, 10:19] = 2
    labels[:, 5:9, 40:45] = 3
    labels[0, 5:9, 50:55] = 4  # the second piece of 3
    labels[:, 50:55, 60:70] = 5  # matched to nothing
    regions = regions_from_label_maps(list(labels))
    ids = torch.where(regions.labels == 4, 3, torch.where(regions.labels == 5, -1, regions.labels))
    cameras = cameras_at(arc_positions(2), width=80, height=60)
    outlines = find_outlines(matched(regions, ids).masks, cameras)
    found = sorted(zip(outlines.view.tolist(), outlines.instance.tolist(), strict=True))
    assert found == [(0, 1), (1, 1), (1, 2), (1, 3)]


@pytest.mark.parametrize("num_views", [2, 3])
def test_without_masks_there_are_no_gaps(num_views: int) -> None:
    regions = regions_from_label_maps(list(np.zeros((num_views, 60, 80), np.int64)))
    cameras = cameras_at(arc_positions(num_views), width=80, height=60)
    outlines = find_outlines(Masks.of(regions), cameras)
    pairs = pair_outlines(outlines, cameras)
    residuals = tangency_residuals(outlines, pairs, cameras, world_per_px=torch.ones(num_views))
    assert len(residuals.px) == len(residuals.weight) == 0
