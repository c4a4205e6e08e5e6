"""Cameras against features of the photos: focal lengths, poses and groups; and photos that tell nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from mvseg.checks.epipolar_distances import (
    distance_findings,
    epipolar_distances,
    focal_factor,
    fundamental,
    scale_focal,
)
from mvseg.checks.photo_matches import PhotoMatches, find_photo_features, match_pair, match_photos, neighbours
from mvseg.errors import InputError
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.poses.sift import Sift
from mvseg.scene import Cameras, Scene
from two_worlds import every_second_farther, half_turned

NAMES = tuple(f"{view:03d}" for view in range(9))


@pytest.fixture(scope="module")
def photos(demo_scene: Scene) -> Photos:
    return Photos(demo_scene)


@pytest.fixture(scope="module")
def shared(photos: Photos, demo_scene: Scene) -> list[PhotoMatches]:
    return match_photos(photos, demo_scene.cameras)


def say(shared: list[PhotoMatches], cameras: Cameras) -> list[tuple[str, tuple[int, ...]]]:
    return [(each.code, each.views) for each in distance_findings(shared, cameras, NAMES)]


def one_turned(cameras: Cameras) -> Cameras:
    R = cameras.R.clone()
    R[2] = half_turned(cameras, 10).R[2]
    return replace(cameras, R=R)


def test_right_cameras_have_no_finding(shared: list[PhotoMatches], demo_scene: Scene) -> None:
    significant = [pair for pair in shared if pair.is_significant]
    assert len(significant) >= 8
    assert focal_factor(significant, demo_scene.cameras) == 1
    assert say(shared, demo_scene.cameras) == []


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.1, 2.0])
def test_a_wrong_focal_length_is_measured(factor: float, shared: list[PhotoMatches], demo_scene: Scene) -> None:
    significant = [pair for pair in shared if pair.is_significant]
    cameras = scale_focal(demo_scene.cameras, factor)
    assert focal_factor(significant, cameras) == pytest.approx(1 / factor, rel=0.04)
    assert say(shared, cameras) == [("focal_lengths_wrong", ())]


@pytest.mark.parametrize(
    ("fault", "views", "code"),
    [
        (partial(every_second_farther, factor=1.1), (1, 3, 5, 7), "features_off_group"),
        (partial(half_turned, degrees=10), (0, 1, 2, 3), "features_off_group"),
        (partial(half_turned, degrees=-10), (0, 1, 2, 3), "features_off_group"),
        (one_turned, (2,), "features_off_one"),
        (lambda cameras: cameras[[8, *range(8)]], (), "features_contradict"),
    ],
    ids=["t x 1.1", "half turned", "turned the other way", "one turned", "cameras of the previous photo"],
)
def test_wrong_poses_are_named(
    fault: Callable[[Cameras], Cameras], views: tuple[int, ...], code: str, photos: Photos, demo_scene: Scene
) -> None:
    cameras = fault(demo_scene.cameras)
    shared = match_photos(photos, cameras)  # wrong about what is near, too
    assert say(shared, cameras) == [(code, views)]


def test_a_cause_explains_most_of_what_is_wrong(shared: list[PhotoMatches], demo_scene: Scene) -> None:
    """Leaves move in wind: two pairs of photos that contradict their cameras, among many that do not, accuse none."""

    def shake(pair: PhotoMatches) -> PhotoMatches:
        return replace(pair, xy=pair.xy + np.array([0.0, 9.0])[:, None, None])

    significant = [pair for pair in shared if pair.is_significant]
    first = next(pair for pair in significant if 4 in pair.views)
    other = next(pair for pair in significant if not {*first.views} & {*pair.views})
    moved = [shake(pair) if pair in (first, other) else pair for pair in shared]
    assert say(moved, demo_scene.cameras) == []
    with_4 = [shake(pair) if 4 in pair.views else pair for pair in shared]
    assert say(with_4, demo_scene.cameras) == [("features_off_one", (4,))]


def test_a_common_scale_is_invisible(shared: list[PhotoMatches], demo_scene: Scene) -> None:
    assert say(shared, demo_scene.cameras.scale(3.0)) == []


def test_what_stands_still_tells_nothing(shared: list[PhotoMatches], photos: Photos, demo_scene: Scene) -> None:
    """A wall behind a turntable is seen at the same pixels of all photos."""
    still = [replace(pair, num_still=2 * pair.xy.shape[1]) for pair in shared]
    assert say(still, scale_focal(demo_scene.cameras, 0.5)) == []
    same = match_photos(lambda _: photos(3), demo_scene.cameras[:3])
    assert all(pair.xy.shape[1] == 0 for pair in same)
    assert all(pair.num_still > 50 for pair in same)


def test_plain_photos_tell_nothing(demo_scene: Scene) -> None:
    black = np.zeros((480, 640, 3), np.uint8)
    assert len(find_photo_features(black)) == 0
    shared = match_photos(lambda _: black, demo_scene.cameras)
    assert not any(pair.is_significant for pair in shared)
    assert say(shared, scale_focal(demo_scene.cameras, 0.5)) == []


def test_photos_that_cannot_be_read_are_left_out(photos: Photos, demo_scene: Scene) -> None:
    def read(view: int) -> np.ndarray:
        if view == 3:
            raise InputError("broken")
        return photos(view)

    shared = match_photos(read, demo_scene.cameras[:5])
    assert {view for pair in shared for view in pair.views} == {0, 1, 2, 4}


def test_features_that_fit_nothing_are_no_evidence() -> None:
    random = np.random.default_rng(0)
    for num in (20, 40, 200):
        xy = random.uniform(0, 480, (2, num, 2))
        nothing = np.zeros(num, np.float32)
        described = np.eye(num, dtype=np.uint8)
        one, other = (Sift(px=px, scale=nothing, angle=nothing, descriptors=described) for px in xy.astype(np.float32))
        assert not match_pair((0, 1), one, other, unit_px=1.0).is_significant


def test_neighbours_are_near_and_few(demo_scene: Scene) -> None:
    cameras = demo_scene.cameras
    pairs = neighbours(cameras)
    assert {view for pair in pairs for view in pair} == set(range(9))
    assert len(pairs) <= 36
    many = neighbours(cameras[torch.arange(9).repeat(7)])  # of views that share a place, none
    assert 1 <= len(many) <= 32
    assert all(i % 9 != j % 9 for i, j in many)


def test_epipolar_distances_are_pixels(demo_scene: Scene) -> None:
    """A point that is moved by 6 px across its epipolar line in one photo misses by 6 / sqrt(2) where the photos are
    alike (Sampson)."""
    cameras = demo_scene.cameras
    points = torch.tensor([[0.0, 0, 80], [20, 10, 60], [-30, 5, 90]]).double()
    xy = cameras.project(points)[0][[3, 5]].numpy()
    F = fundamental((3, 5), cameras)
    assert epipolar_distances(xy, F).max() < 1e-6
    lines = np.concatenate((xy[0], np.ones((3, 1))), 1) @ F.T
    across = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    moved = np.stack((xy[0], xy[1] + 6 * across))
    np.testing.assert_allclose(epipolar_distances(moved, F), 6 / np.sqrt(2), rtol=0.2)


@pytest.mark.slow
@pytest.mark.shared_data
def test_real_photos_accuse_wrong_focal_lengths_only(shared_data: Path) -> None:
    scene = load_scene(shared_data / "basil-0729")
    names = tuple(view.name for view in scene.views)
    shared = match_photos(Photos(scene), scene.cameras)
    assert distance_findings(shared, scene.cameras, names) == []
    (found,) = distance_findings(shared, scale_focal(scene.cameras, 1.1), names)
    assert found.code == "focal_lengths_wrong"
