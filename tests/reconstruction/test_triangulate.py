from __future__ import annotations

import numpy as np
import torch

from blade_scene import ring_cameras
from mvseg.reconstruction.triangulate import triangulate_points


def see(cameras, points: np.ndarray) -> dict[int, list[tuple[int, np.ndarray]]]:
    px = cameras.project(torch.from_numpy(points))[0].numpy()
    return {index: [(view, px[view, index]) for view in range(len(cameras))] for index in range(len(points))}


def test_points_come_back_and_those_that_say_nothing_are_left_out() -> None:
    cameras, points = ring_cameras(4), np.random.default_rng(0).normal(size=(6, 3)) * 0.3
    found = triangulate_points(cameras, see(cameras, points))
    np.testing.assert_allclose([found[index] for index in range(6)], points, atol=1e-9)
    cameras, points = ring_cameras(3), np.zeros((5, 3))
    seen = see(cameras, points)
    seen[1] = seen[1][:1]  # in one view only
    seen[2] = [*seen[2], seen[2][0]]  # twice in a view
    seen[3][1] = (1, seen[3][1][1] + 20)  # a mistake
    assert list(triangulate_points(cameras, seen)) == [0, 4]
    cameras = ring_cameras(3, arc_deg=0.2, elevations_deg=(30,))
    assert triangulate_points(cameras, see(cameras, np.zeros((1, 3)))) == {}
    assert len(triangulate_points(ring_cameras(3, arc_deg=30), see(ring_cameras(3, arc_deg=30), np.zeros((1, 3))))) == 1
