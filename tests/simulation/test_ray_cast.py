"""Rendered views: ids and depths against an independent rasteriser on OpenCV's projection, planes, and seeds."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mvseg.scene import Cameras
from mvseg.simulation.blades import Leaf
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.look import draw_look
from mvseg.simulation.pot import Part
from mvseg.simulation.ray_cast import Rendering, build_stage, render_stage
from rendered import render_view

SIZE = 40


def ring(plant: SimulatedPlant, size: int = SIZE) -> Cameras:
    return arc_cameras(4, plant, width=size, height=size)


def shoot(plant: SimulatedPlant, *, seed: int = 0, size: int = SIZE) -> Rendering:
    return render_view(plant, ring(plant, size), 0, seed=seed)


def make_square(leaf_id: int, corners: list[list[float]]) -> Leaf:
    uv = np.array([[0.0, -1.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    return Leaf(leaf_id=leaf_id, vertices=np.array(corners), faces=faces, uv=uv, length=1.0, width=1.0, area=1.0)


def make_level_square(leaf_id: int, half: float, z: float) -> Leaf:
    return make_square(leaf_id, [[-half, half, z], [-half, -half, z], [half, -half, z], [half, half, z]])


def one_camera(*, focal: float, size: tuple[int, int], R: torch.Tensor, height: float) -> Cameras:
    """One view with the world's origin on its optical axis, `height` ahead."""
    width, rows = size
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, rows / 2], [0, 0, 1]]])
    return Cameras(K=K, R=R[None], t=torch.tensor([[0.0, 0.0, height]]), sizes=torch.tensor([[width, rows]]))


def look_down(height: float, *, focal: float = 80.0, size: tuple[int, int] = (16, 16)) -> Cameras:
    return one_camera(focal=focal, size=size, R=torch.diag(torch.tensor([1.0, -1.0, -1.0])), height=height)


def look_up(height: float) -> Cameras:
    return one_camera(focal=80.0, size=(16, 16), R=torch.eye(3), height=height)


def rasterize(plant: SimulatedPlant, cameras: Cameras, view: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Ids and depths by projecting every triangle with OpenCV and searching the nearest one over each pixel centre."""
    K, R, t = (part[view].numpy() for part in (cameras.K, cameras.R, cameras.t))
    size = int(cameras.sizes[view, 0])
    meshes = [(leaf.vertices, leaf.faces, leaf.leaf_id) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces, 0) for part in plant.parts]
    zero_centred = K.copy()
    zero_centred[:2, 2] -= 0.5  # OpenCV's top-left pixel has its centre at (0, 0)
    rows, columns = np.mgrid[:size, :size]
    ids, nearest = np.zeros((size, size), np.int64), np.full((size, size), np.inf)
    for vertices, faces, leaf_id in meshes:
        px = cv2.projectPoints(vertices, cv2.Rodrigues(R)[0], t, zero_centred, None)[0][:, 0]
        z = (vertices @ R.T + t)[:, 2]
        for a, b, c in faces[(z[faces] > 0).all(1)]:
            low = np.maximum(np.ceil(px[[a, b, c]].min(0)).astype(int), 0)
            high = np.minimum(np.floor(px[[a, b, c]].max(0)).astype(int), size - 1)
            edges = np.array([px[b] - px[a], px[c] - px[a]]).T
            if (low > high).any() or abs(np.linalg.det(edges)) < 1e-12:
                continue
            inside = np.s_[low[1] : high[1] + 1, low[0] : high[0] + 1]
            points = np.stack([columns[inside].ravel(), rows[inside].ravel()]) - px[a][:, None]
            beta, gamma = np.linalg.solve(edges, points)
            weights = np.stack([1 - beta - gamma, beta, gamma])
            depth = np.where((weights >= 0).all(0), 1 / (weights / z[[a, b, c]][:, None]).sum(0), np.inf)
            closer = depth.reshape(nearest[inside].shape) < nearest[inside]
            nearest[inside] = np.where(closer, depth.reshape(closer.shape), nearest[inside])
            ids[inside] = np.where(closer, leaf_id, ids[inside])
    return ids, nearest


@pytest.mark.parametrize(("family", "view"), [("ovate", 0), ("rosette", 1), ("lobed", 3)])
def test_ids_and_depths_agree_with_opencv_projection(family: str, view: int) -> None:
    plant = grow_plant(family, 5, seed=1)
    shot = render_view(plant, ring(plant), view, seed=0)
    ids, depth = rasterize(plant, ring(plant), view)
    same = shot.ids == ids
    assert (shot.ids > 0).sum() > 60
    assert same.mean() > 0.998  # a pixel centre on an edge may go either way
    seen = same & np.isfinite(depth)
    assert np.allclose(shot.depth[seen], depth[seen], rtol=1e-4)


def test_pixel_centres_decide_and_a_ray_that_hits_nothing_is_infinitely_long() -> None:
    cameras = look_down(100.0, focal=100.0, size=(8, 6))  # one unit of the plane is one pixel
    square = make_square(7, [[-2.4, 1.4, 0], [-2.4, -1.6, 0], [1.6, -1.6, 0], [1.6, 1.4, 0]])
    ids = render_view(SimulatedPlant("ovate", (square,), ()), cameras, 0, seed=0).ids
    expected = np.zeros((6, 8), np.uint16)
    expected[2:5, 2:6] = 7  # rows 1.6 to 4.6 and columns 1.6 to 5.6 hold the centres 2.5 to 4.5 and 2.5 to 5.5
    assert ids.tolist() == expected.tolist()
    stake = Part("stake", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32))
    away = render_view(SimulatedPlant("ovate", (), (stake,)), look_up(-50.0), 0, seed=0)
    assert np.isinf(away.depth).all()
    assert not away.ids.any()


def test_ids_and_depths_do_not_depend_on_the_look_and_views_share_the_light() -> None:
    plant = grow_plant("compound", 12, seed=4)
    one, two = shoot(plant, seed=1), shoot(plant, seed=2)
    assert np.array_equal(one.ids, two.ids)
    assert np.array_equal(one.depth, two.depth)
    assert np.abs(one.rgb.astype(int) - two.rgb).mean() > 5
    stage = build_stage(SimulatedPlant("ovate", (make_level_square(1, 900, 0),), ()), seed=0)
    cameras = [look_down(height, size=(64, 64)) for height in (300.0, 300.5)]
    one, two = (render_stage(stage, some, 0).rgb.astype(float) for some in cameras)
    assert np.abs(one - two).mean() > 0.5
    assert one.mean() == pytest.approx(two.mean(), abs=2)


@pytest.mark.parametrize(("seed", "family"), list(enumerate(FAMILIES)))
def test_photos_are_exposed_and_leaves_are_green(seed: int, family: str) -> None:
    shot = shoot(grow_plant(family, 6, seed), seed=seed, size=64)
    assert shot.rgb.shape == (64, 64, 3)
    assert shot.rgb.dtype == np.uint8
    assert shot.ids.dtype == np.uint16
    assert shot.depth.dtype == np.float32
    assert 10 < shot.rgb.mean() < 245
    _, green, blue = shot.rgb[shot.ids > 0].mean(0)
    assert green > 20
    assert green > 1.05 * blue


def test_shadow_of_a_leaf_darkens_the_soil() -> None:
    soil = make_level_square(1, 900, 0)
    plant = SimulatedPlant("ovate", (make_level_square(1, 60, 40),), (Part("ground", soil.vertices, soil.faces),))
    looks = ((seed, draw_look(np.random.default_rng(seed))) for seed in range(50))
    sunny, look = next((seed, look) for seed, look in looks if look.sun[1] > 1.4)
    shot = render_view(plant, look_down(200.0, focal=40.0, size=(64, 64)), 0, seed=sunny)
    center = np.array([0.0, 0.0, 40.0]) - look.to_sun * 40 / look.to_sun[2]  # where the roof's shadow falls
    column, row = 32 + 40 * center[0] / 200, 32 - 40 * center[1] / 200
    ground = np.where(shot.ids == 0, shot.rgb.mean(-1), np.nan)
    shade = ground[max(int(row) - 12, 0) : int(row) + 12, max(int(column) - 12, 0) : int(column) + 12]
    assert np.nanmin(shade) < 0.8 * np.nanmedian(ground)
