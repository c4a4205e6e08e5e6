"""One scene told in other ways: its world turned or mirrored, its photos turned pixel for pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mvseg.scene import Cameras

Told = tuple[list[np.ndarray], Cameras]  # V label maps, V cameras


def turn_world(maps: list[np.ndarray], cameras: Cameras, seed: int = 0) -> Told:
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return maps, replace(cameras, R=cameras.R @ turn.T)


def mirror_world(maps: list[np.ndarray], cameras: Cameras) -> Told:
    """x -> -x in the world and in all photos."""
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    K = cameras.K.clone()
    K[:, 0, 2] = cameras.sizes[:, 0] - K[:, 0, 2]
    told = replace(cameras, K=K, R=mirror @ cameras.R @ mirror, t=cameras.t @ mirror)
    return [each[:, ::-1].copy() for each in maps], told


def turn_photos(maps: list[np.ndarray], cameras: Cameras) -> Told:
    """By a quarter, to the left."""
    quarter = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    (fx, fy), (cx, cy) = cameras.K[:, [0, 1], [0, 1]].T, cameras.K[:, :2, 2].T
    K = torch.zeros_like(cameras.K)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = fy, fx, cy, cameras.sizes[:, 0] - cx, 1
    told = Cameras(K=K, R=quarter @ cameras.R, t=cameras.t @ quarter.T, sizes=cameras.sizes.flip(1))
    return [np.rot90(each).copy() for each in maps], told


def tell_otherwise(maps: list[np.ndarray], cameras: Cameras) -> dict[str, Told]:
    """Each of them, and all three at once."""
    return {
        "world turned": turn_world(maps, cameras),
        "world mirrored": mirror_world(maps, cameras),
        "photos turned": turn_photos(maps, cameras),
        "all three": turn_photos(*mirror_world(*turn_world(maps, cameras, 1))),
    }
