"""Refined poses: laws, and scenes whose poses are known exactly."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import torch

from benchmarks.faults import disc
from matched import matched
from mvseg.errors import InputWarning
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.matching.tangency import move_cameras
from mvseg.poses.refine_poses import RefinedPoses, adjust, fit_poses, held_out_residuals, refine_poses
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from synthetic import BallScene, ball_scene, cameras_at, moved, permute_views


@pytest.fixture(scope="module")
def scene() -> BallScene:
    return ball_scene(9, 6, seed=3, radius=0.25)


@pytest.fixture(scope="module")
def noisy(scene: BallScene) -> Cameras:
    return put_noise(scene.cameras, px=5)


def put_noise(cameras: Cameras, *, px: float) -> Cameras:
    steps = torch.from_numpy(np.random.default_rng(0).normal(0, px, (len(cameras), 6)))
    return move_cameras(cameras, steps, torch.full((len(cameras),), 10 / 400).double())


def pose_error(cameras: Cameras, scene: BallScene) -> float:
    """Pixels; how far from each other the rays through what the true cameras see of the balls are, as seen."""
    px = scene.cameras.project(scene.centers)[0]
    found = []
    for ball in range(len(scene.centers)):
        rows = []
        for view in range(len(cameras)):
            P = cameras.K[view] @ torch.cat((cameras.R[view], cameras.t[view][:, None]), 1)
            rows += [px[view, ball, 0] * P[2] - P[0], px[view, ball, 1] * P[2] - P[1]]
        point = torch.linalg.svd(torch.stack(rows))[2][-1]
        found.append(point[:3] / point[3])
    return float((cameras.project(torch.stack(found))[0] - px).norm(dim=2).median())


def true_matching(scene: BallScene) -> Matching:
    return matched(scene.regions, scores=1.0)


def refine(scene: BallScene, cameras: Cameras, regions: Regions | None = None) -> RefinedPoses:
    """What becomes of the poses when all ids are right from the start."""
    known = replace(scene, regions=regions or scene.regions)
    return refine_poses(cameras, lambda posed: true_matching(known))


def test_noise_gets_smaller(scene: BallScene, noisy: Cameras) -> None:
    poses = refine_poses(noisy, partial(match_regions, scene.regions))
    assert poses.is_refined
    assert poses.residual_px[1] < 0.3 * poses.residual_px[0]
    assert pose_error(noisy, scene) > 2
    assert pose_error(poses.cameras, scene) < 0.4


def test_masks_drawn_too_large_do_not_mislead(scene: BallScene, noisy: Cameras) -> None:
    rng, maps = np.random.default_rng(4), []
    for labels in scene.label_maps:
        wide = labels.copy()
        for ball in rng.choice(9, 4, replace=False) + 1:
            grown = cv2.dilate((labels == ball).astype(np.uint8), disc(2)) > 0
            wide[grown & (labels == 0)] = ball
        maps.append(wide)
    poses = refine(scene, noisy, regions_from_label_maps(maps))
    assert poses.is_refined
    assert pose_error(poses.cameras, scene) < 0.5


def test_exact_poses_stay(scene: BallScene) -> None:
    poses = refine_poses(scene.cameras, partial(match_regions, scene.regions))
    assert not poses.is_refined
    assert poses.cameras is scene.cameras


def test_order_of_views_does_not_matter(scene: BallScene, noisy: Cameras) -> None:
    order = [3, 0, 5, 1, 4, 2]
    other = permute_views(scene, order)
    one = fit_poses(adjust(true_matching(scene).masks, noisy))
    two = fit_poses(adjust(true_matching(other).masks, noisy[order]))
    assert torch.allclose(one.R[order], two.R, atol=1e-6)
    assert torch.allclose(one.t[order], two.t, atol=1e-5)


def test_the_world_may_be_moved(scene: BallScene, noisy: Cameras) -> None:
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]).double()
    elsewhere = (250.0, turn, torch.tensor([3e4, -2e4, 5e3]).double())
    one = fit_poses(adjust(true_matching(scene).masks, noisy))
    two = fit_poses(adjust(true_matching(scene).masks, moved(noisy, *elsewhere)))
    expected = moved(one, *elsewhere)
    assert torch.allclose(two.R, expected.R, atol=1e-6)
    assert torch.allclose(two.centers, expected.centers, atol=1e-2)  # of 2500


def test_the_world_stays_where_it_was(scene: BallScene, noisy: Cameras) -> None:
    """What masks cannot tell, scale and axes, is that of the given poses."""
    refined = fit_poses(adjust(true_matching(scene).masks, noisy))
    deviation = [(cameras.centers - cameras.centers.mean(0)).norm() for cameras in (noisy, refined)]
    assert float(deviation[1] / deviation[0]) == pytest.approx(1, abs=0.01)
    assert float((refined.centers.mean(0) - noisy.centers.mean(0)).norm()) < 0.1


def test_gaps_of_leaves_left_out_grow_with_exact_poses(scene: BallScene) -> None:
    before, after = held_out_residuals(true_matching(scene).masks, scene.cameras)
    assert 0 < before < 0.5
    assert before < after < 1


def test_one_camera_that_is_off_is_put_right(scene: BallScene) -> None:
    steps = torch.zeros(6, 6).double()
    steps[2] = torch.tensor([6, -5, 4, 3, -6, 2])
    off = move_cameras(scene.cameras, steps, torch.full((6,), 10 / 400).double())
    poses = refine(scene, off)
    assert poses.is_refined
    assert pose_error(poses.cameras, scene) < 0.4


@pytest.mark.parametrize("score", [1.0, 0.5])
def test_poses_that_make_ids_less_sure_are_not_taken(scene: BallScene, noisy: Cameras, score: float) -> None:
    """And warnings on the way are not heard."""

    def match(cameras: Cameras) -> Matching:
        warnings.warn("on the way", InputWarning, stacklevel=1)
        return matched(scene.regions, scores=1.0 if cameras is noisy else score)

    poses = refine_poses(noisy, match)
    assert poses.is_refined == (score == 1)
    assert (poses.cameras is noisy) == (score != 1)


def test_nothing_to_refine_with(scene: BallScene) -> None:
    empty = regions_from_label_maps([np.zeros_like(labels) for labels in scene.label_maps])
    poses = refine_poses(scene.cameras, partial(match_regions, empty))
    assert not poses.is_refined
    assert all(np.isnan(residual) for residual in poses.residual_px)
    alone = regions_from_label_maps([(labels == 1).astype(np.int64) for labels in scene.label_maps])
    assert not refine(scene, scene.cameras, alone).is_refined


def test_equations_that_are_singular_move_no_camera(scene: BallScene, noisy: Cameras) -> None:
    """Rays that are all but parallel meet so far away that a step of a pixel outweighs every prior."""
    problem = adjust(true_matching(scene).masks, noisy)
    stayed = fit_poses(replace(problem, world_per_px=1e200 * problem.world_per_px))
    assert torch.equal(stayed.R, noisy.R)
    assert torch.equal(stayed.t, noisy.t)


def test_a_leaf_that_no_pair_of_views_tells_anything_of() -> None:
    """Two cameras, one before the other: the masks around the line through both have no ends that could miss."""
    cameras = cameras_at(torch.tensor([[0.0, 0.0, -20.0], [0.0, 0.0, -10.0]], dtype=torch.float64))
    labels = np.zeros((240, 320), np.int64)
    labels[100:140, 140:180] = 1
    regions = regions_from_label_maps([labels, labels])
    assert np.isnan(held_out_residuals(matched(regions).masks, cameras)).all()
