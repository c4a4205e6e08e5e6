"""Meshes and cameras of the page, carried back into the world."""

from __future__ import annotations

import base64
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from blade_scene import ring_cameras
from known_leaves import bent_blade
from mvseg.results.report.space import (
    STEPS,
    VOXEL_FACES,
    Frame,
    describe_cameras,
    describe_space,
    find_frame,
    grid_step,
    small_meshes,
)
from mvseg.results.result import Instances, Result
from mvseg.scene import Cameras, Scene, View

CAMERAS = ring_cameras(5)
SCENE = Scene("plant", tuple(View(str(view), None) for view in range(5)), CAMERAS)  # type: ignore[arg-type]


def to_world(frame: Frame, points: np.ndarray) -> np.ndarray:
    return (frame.radius * points + frame.middle) @ frame.rotation


def decode(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, 3)


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
def test_photos_stand_where_their_cameras_see_them(up: tuple[float, float, float] | None) -> None:
    """A point on the ray through a corner of the base is seen in that corner of the photo."""
    frame = find_frame(replace(SCENE, up=up), {})
    for view, entry in enumerate(describe_cameras(CAMERAS, frame)):
        center, corners, depth = np.array(entry["center"]), np.array(entry["corners"]), 0.3
        px, depths = CAMERAS.project(torch.from_numpy(to_world(frame, center + depth * corners)))
        width, height = CAMERAS.sizes[view].tolist()
        expected = [[0, 0], [width, 0], [width, height], [0, height]]
        np.testing.assert_allclose(px[view].numpy(), expected, atol=0.02 * width)
        np.testing.assert_allclose(depths[view].numpy(), depth * frame.radius, rtol=1e-3)
        assert np.dot(entry["up"], corners[0] - corners[3]) > 0
        np.testing.assert_allclose(entry["ahead"], corners.mean(0), atol=1e-4)  # their principal point is the middle
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    if up is not None:
        np.testing.assert_allclose(frame.turn(np.array(up)), [0, 1, 0], atol=1e-9)
        assert frame.is_up_known
    else:
        assert np.mean([entry["up"][1] for entry in describe_cameras(CAMERAS, frame)]) > 0.5


def test_cameras_that_look_straight_down_have_an_up() -> None:
    down = Cameras(
        K=CAMERAS.K[:2],
        R=torch.tensor([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], [[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]]),
        t=torch.tensor([[0.0, 0, 9], [1.0, 0, 9]]),
        sizes=CAMERAS.sizes[:2],
    )
    frame = find_frame(Scene("plant", SCENE.views[:2], down), {})
    np.testing.assert_allclose(frame.turn(np.array([0, 0, 1.0])), [0, 1, 0], atol=1e-9)
    assert np.isfinite(frame.middle).all()


def test_meshes_are_small_and_where_the_leaves_are(balls: Result) -> None:
    blade = bent_blade(length=8)
    mixed = replace(balls, instances=replace(balls.instances, surfaces={2: blade}))
    meshes = small_meshes(mixed)
    assert set(meshes) == {1, 2, 3}
    assert [len(meshes[leaf].faces) <= VOXEL_FACES for leaf in (1, 2, 3)] == [True] * 3
    assert meshes[2].area == pytest.approx(blade.area, rel=0.02)
    assert balls.voxels is not None
    assert meshes[1].volume == pytest.approx(balls.voxels[1].mesh().volume, rel=0.03)
    space = describe_space(mixed)
    frame = find_frame(mixed.scene, meshes)
    for leaf, entry in space["leaves"].items():
        points, faces = decode(entry["points"], "<i2") / STEPS, decode(entry["faces"], "<u2")
        assert np.linalg.norm(points, axis=1).max() <= 1.0001
        np.testing.assert_allclose(to_world(frame, points), meshes[leaf].vertices, atol=1e-4 * frame.radius)
        back = trimesh.Trimesh(points, faces, process=False)
        assert back.area * frame.radius**2 == pytest.approx(meshes[leaf].area, rel=1e-3)
    lowest = min(decode(entry["points"], "<i2")[:, 1].min() for entry in space["leaves"].values())
    assert space["ground"] == pytest.approx(lowest / STEPS, abs=1e-3)
    assert space["isUpKnown"] is False


def test_without_shapes_there_are_cameras(balls: Result) -> None:
    space = describe_space(replace(balls, instances=Instances()))
    assert space["leaves"] == {}
    distances = [np.linalg.norm(entry["center"]) for entry in space["cameras"]]
    np.testing.assert_allclose(distances, 4, rtol=0.3)


@pytest.mark.parametrize("radius", [0.013, 0.2, 1.0, 3.3, 47.0, 180.0, 99999.0])
def test_squares_of_the_grid_are_round_numbers(radius: float) -> None:
    step = grid_step(radius)
    assert radius / 5 <= step * 1.0001
    assert step <= radius / 2 * 1.0001
    assert f"{step:e}"[0] in "125"
