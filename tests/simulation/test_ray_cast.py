"""Rendered views: ids and depths against an independent rasteriser on OpenCV's projection, planes, and seeds."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.simulation.blades import Leaf
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import FAMILIES, Part, Plant, grow_plant
from mvseg.simulation.ray_cast import Rendering, border_pixels, build_stage, render_stage, render_view, sample_texture

Doubles = NDArray[np.float64]
SIZE = 40


def shoot(plant: Plant, view: int = 0, size: int = SIZE, seed: int = 0) -> tuple[Rendering, Doubles, Doubles, Doubles]:
    cameras = arc_cameras(4, plant, width=size, height=size)
    K, R, t = (x[view].numpy() for x in (cameras.K, cameras.R, cameras.t))
    return render_view(plant, K, R, t, size, size, seed=seed), K, R, t


def make_square(leaf_id: int, corners: list[list[float]]) -> Leaf:
    uv = np.array([[0.0, -1.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    return Leaf(leaf_id, np.array(corners), np.array([[0, 2, 1], [0, 3, 2]], np.int32), uv, 1.0, 1.0, 1.0)


def look_down(height: float) -> tuple[Doubles, Doubles]:
    R = np.diag([1.0, -1.0, -1.0])
    return R, np.array([0.0, 0.0, height])


def rasterize(plant: Plant, K: Doubles, R: Doubles, t: Doubles, size: int) -> tuple[NDArray[np.int64], Doubles]:
    """Ids and depths by projecting every triangle with OpenCV and searching the nearest one over each pixel centre."""
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
    shot, K, R, t = shoot(plant, view)
    ids, depth = rasterize(plant, K, R, t, SIZE)
    same = shot.ids == ids
    assert (shot.ids > 0).sum() > 60
    assert same.mean() > 0.998  # a pixel centre on an edge may go either way
    seen = same & np.isfinite(depth)
    assert np.allclose(shot.depth[seen], depth[seen], rtol=1e-4)


def test_half_a_pixel_matters() -> None:
    """The oracle above would notice zero-centred pixels."""
    plant = grow_plant("ovate", 5, seed=1)
    shot, K, R, t = shoot(plant)
    K[:2, 2] += 0.5
    assert (rasterize(plant, K, R, t, SIZE)[0] == shot.ids).mean() < 0.99


def test_pixel_centres_decide() -> None:
    K = np.array([[100.0, 0, 4], [0, 100.0, 3], [0, 0, 1]])
    R, t = look_down(100.0)  # one unit of the plane is one pixel
    square = make_square(7, [[-2.4, 1.4, 0], [-2.4, -1.6, 0], [1.6, -1.6, 0], [1.6, 1.4, 0]])
    ids = render_view(Plant("ovate", (square,), ()), K, R, t, 8, 6, seed=0).ids
    expected = np.zeros((6, 8), np.uint16)
    expected[2:5, 2:6] = 7  # rows 1.6 to 4.6 and columns 1.6 to 5.6 hold the centres 2.5 to 4.5 and 2.5 to 5.5
    assert ids.tolist() == expected.tolist()


def test_depth_of_a_level_and_of_a_tilted_plane() -> None:
    K = np.array([[80.0, 0, 8], [0, 80.0, 8], [0, 0, 1]])
    R, t = look_down(300.0)
    level = make_square(1, [[-90, 90, 0], [-90, -90, 0], [90, -90, 0], [90, 90, 0]])
    shot = render_view(Plant("ovate", (level,), ()), K, R, t, 16, 16, seed=0)
    assert shot.depth == pytest.approx(np.full((16, 16), 300.0), rel=1e-6)
    tilted = make_square(1, [[-90, 90, -45], [-90, -90, -45], [90, -90, 45], [90, 90, 45]])  # z = x / 2
    shot = render_view(Plant("ovate", (tilted,), ()), K, R, t, 16, 16, seed=0)
    slope = (np.arange(16) + 0.5 - 8) / 80  # x = slope * depth and depth = 300 - x / 2
    assert shot.depth == pytest.approx(np.tile(300 / (1 + slope / 2), (16, 1)), rel=1e-6)


def test_the_nearer_leaf_hides_the_other_from_both_sides() -> None:
    K = np.array([[80.0, 0, 8], [0, 80.0, 8], [0, 0, 1]])
    leaves = tuple(
        make_square(k, [[-90, 90, z], [-90, -90, z], [90, -90, z], [90, 90, z]]) for k, z in ((1, 0.0), (2, 5.0))
    )
    above = render_view(Plant("ovate", leaves, ()), K, *look_down(300.0), 16, 16, seed=0)
    below = render_view(Plant("ovate", leaves, ()), K, np.eye(3), np.array([0.0, 0.0, 300.0]), 16, 16, seed=0)
    assert np.unique(above.ids).tolist() == [2]
    assert np.unique(below.ids).tolist() == [1]


def test_what_nothing_is_hit_by_is_infinitely_far() -> None:
    K = np.array([[80.0, 0, 8], [0, 80.0, 8], [0, 0, 1]])
    stake = Part("stake", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32))
    away = render_view(Plant("ovate", (), (stake,)), K, np.eye(3), np.array([0.0, 0.0, -50.0]), 16, 16, seed=0)
    assert np.isinf(away.depth).all()
    assert not away.ids.any()


def test_ids_and_depths_do_not_depend_on_the_look() -> None:
    plant = grow_plant("compound", 12, seed=4)
    one, two = shoot(plant, seed=1)[0], shoot(plant, seed=2)[0]
    assert np.array_equal(one.ids, two.ids)
    assert np.array_equal(one.depth, two.depth)
    assert np.abs(one.rgb.astype(int) - two.rgb).mean() > 5


def test_reruns_are_bit_identical() -> None:
    one, two = (shoot(grow_plant("strap", 6, seed=4), seed=1)[0] for _ in range(2))
    for field in ("rgb", "ids", "depth"):
        assert getattr(one, field).tobytes() == getattr(two, field).tobytes()


def test_views_share_the_light_but_not_the_noise() -> None:
    square = make_square(1, [[-900, 900, 0], [-900, -900, 0], [900, -900, 0], [900, 900, 0]])
    stage = build_stage(Plant("ovate", (square,), ()), seed=0)
    K = np.array([[80.0, 0, 32], [0, 80.0, 32], [0, 0, 1]])
    one, two = (render_stage(stage, K, *look_down(height), 64, 64).rgb.astype(float) for height in (300.0, 300.5))
    assert np.abs(one - two).max() > 0
    assert one.mean() == pytest.approx(two.mean(), abs=2)


@pytest.mark.parametrize("family", FAMILIES)
def test_photos_are_exposed_and_leaves_are_green(family: str) -> None:
    for seed in range(3):
        shot = shoot(grow_plant(family, 10, seed), seed=seed, size=80)[0]
        assert shot.rgb.shape == (80, 80, 3)
        assert shot.rgb.dtype == np.uint8
        assert shot.ids.dtype == np.uint16
        assert shot.depth.dtype == np.float32
        assert 10 < shot.rgb.mean() < 245
        _, green, blue = shot.rgb[shot.ids > 0].mean(0)
        assert green > 20
        assert green > 1.05 * blue


def test_shadow_of_a_leaf_darkens_the_soil() -> None:
    roof = make_square(1, [[-60, 60, 40], [-60, -60, 40], [60, -60, 40], [60, 60, 40]])
    soil = make_square(1, [[-900, 900, 0], [-900, -900, 0], [900, -900, 0], [900, 900, 0]])
    plant = Plant("ovate", (roof,), (Part("ground", soil.vertices, soil.faces),))
    K = np.array([[40.0, 0, 32], [0, 40.0, 32], [0, 0, 1]])
    sunny = next(seed for seed in range(50) if build_stage(plant, seed=seed).look.sun[1] > 1.4)
    look = build_stage(plant, seed=sunny).look
    shot = render_view(plant, K, *look_down(200.0), 64, 64, seed=sunny)
    center = np.array([0.0, 0.0, 40.0]) - look.to_sun * 40 / look.to_sun[2]  # where the roof's shadow falls
    column, row = 32 + 40 * center[0] / 200, 32 - 40 * center[1] / 200
    ground = np.where(shot.ids == 0, shot.rgb.mean(-1), np.nan)
    shade = ground[max(int(row) - 12, 0) : int(row) + 12, max(int(column) - 12, 0) : int(column) + 12]
    assert np.nanmin(shade) < 0.8 * np.nanmedian(ground)


def test_border_pixels_touch_another_label() -> None:
    labels = np.array([[1, 1, 2], [1, 1, 2], [1, 1, 1]], np.int32)
    assert border_pixels(labels).tolist() == [[False, True, True], [False, True, True], [False, False, True]]


def test_texture_is_periodic_and_bilinear() -> None:
    texture = np.arange(16, dtype=np.float32).reshape(4, 4)
    x, y = np.array([1.0, 5.0, 1.5, 3.5]), np.array([2.0, -2.0, 2.0, 0.0])
    assert sample_texture(texture, x, y).tolist() == [9.0, 9.0, 9.5, 1.5]


def test_empty_pictures_are_refused() -> None:
    plant = grow_plant("ovate", 1, seed=0)
    with pytest.raises(InputError, match="0 x 5"):
        render_view(plant, np.eye(3), np.eye(3), np.zeros(3), 0, 5, seed=0)
