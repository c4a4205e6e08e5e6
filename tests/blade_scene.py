"""An elliptic blade, flat or bent over a cylinder, in masks that are exact: bending changes neither area nor length."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras

SIZE = 200


@dataclass(frozen=True)
class EllipticBlade:
    """(s / half_length)^2 + (y / half_width)^2 <= 1 on the cylinder of radius `bend` that touches z = 0 at x = 0."""

    half_length: float = 1.0
    half_width: float = 0.45
    bend: float = 1e4

    @property
    def area(self) -> float:
        return np.pi * self.half_length * self.half_width

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Of points on the cylinder (..., 3)."""
        s = self.bend * np.arctan2(points[..., 0], points[..., 2] + self.bend)
        return (s / self.half_length) ** 2 + (points[..., 1] / self.half_width) ** 2 <= 1

    def mask(self, center: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(H, W): do the rays (H, W, 3) from a camera centre meet the blade? Both roots of the quadratic count."""
        x, z = center[0], center[2] + self.bend
        a = rays[..., 0] ** 2 + rays[..., 2] ** 2
        b = x * rays[..., 0] + z * rays[..., 2]
        root = b**2 - a * (x**2 + z**2 - self.bend**2)
        hit = np.zeros(rays.shape[:2], bool)
        for sign in (-1, 1):
            depth = (-b + sign * np.sqrt(np.maximum(root, 0))) / a
            hit |= (root > 0) & (depth > 0) & self.contains(center + depth[..., None] * rays)
        return hit


def ring_cameras(
    num_views: int, *, distance: float = 6.0, elevations_deg: tuple[float, ...] = (25, 60, 40), arc_deg: float = 360
) -> Cameras:
    """Cameras around and above the origin, at changing heights."""
    rotations, centers = [], []
    for view in range(num_views):
        azimuth = np.radians(arc_deg) * view / num_views + 0.3
        elevation = np.radians(elevations_deg[view % len(elevations_deg)])
        out = np.array([
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ])  # fmt: skip
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotations.append(np.stack([right, np.cross(-out, right), -out]))
        centers.append(distance * out)
    R = np.stack(rotations)
    K = np.array([[390.0, 0, SIZE / 2], [0, 390.0, SIZE / 2], [0, 0, 1]])
    return Cameras(
        K=torch.from_numpy(np.tile(K, (num_views, 1, 1))),
        R=torch.from_numpy(R),
        t=torch.from_numpy(-np.einsum("vij,vj->vi", R, np.stack(centers))),
        sizes=torch.tensor([[SIZE, SIZE]] * num_views),
    )


def blade_masks(blade: EllipticBlade, cameras: Cameras) -> list[np.ndarray]:
    """V masks (H, W) bool: one exact ray through each pixel's centre. Each call has its own."""
    return [mask.copy() for mask in _exact_masks(blade, cameras)]


@cache
def _exact_masks(blade: EllipticBlade, cameras: Cameras) -> list[np.ndarray]:
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    px = np.stack([u, v, np.ones_like(u)], -1)
    matrices, centers = cameras.world_from_px.numpy(), cameras.centers.numpy()
    return [blade.mask(center, px @ matrix.T) for center, matrix in zip(centers, matrices, strict=True)]


def as_regions(masks: list[np.ndarray]) -> tuple[Regions, torch.Tensor]:
    """Regions and ids of label maps or masks, whose numbers are the instances."""
    regions = regions_from_label_maps([mask.astype(np.int64) for mask in masks])
    return regions, regions.labels
