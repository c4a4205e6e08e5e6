"""Tubes of known axis and radius in exact masks: one ray through each pixel's centre."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from blade_scene import SIZE, ring_cameras
from mvseg.reconstruction.stem.stem_axis import sweep_circle
from mvseg.scene import Cameras

CAMERAS = ring_cameras(10)
T = np.linspace(0, 1, 60)
BENT = np.stack([0.5 * np.sin(1.5 * T), 0.2 * T, 1.8 * T - 1], 1)


def tube_masks(points: np.ndarray, radius: np.ndarray, cameras: Cameras = CAMERAS) -> list[np.ndarray]:
    """V masks (H, W) bool of a tube around points (P, 3) with radii (P,)."""
    mesh = sweep_circle(points, radius)
    bvh = EmbreeScene(robust=True)
    TriangleMesh(bvh, np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32))
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    px = np.stack([columns.ravel(), rows.ravel(), np.ones(SIZE * SIZE)], 1)
    masks = []
    for matrix, center in zip(cameras.world_from_px.numpy(), cameras.centers.numpy(), strict=True):
        rays = (px @ matrix.T).astype(np.float32)
        face = bvh.run(np.tile(center.astype(np.float32), (len(rays), 1)), rays)
        masks.append((face >= 0).reshape(SIZE, SIZE))
    return masks
