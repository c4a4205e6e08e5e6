"""Three known leaves and six cameras around them: the first leaf hides a part of the second from above."""

from __future__ import annotations

import numpy as np

from blade_scene import SIZE, ring_cameras
from known_leaves import flat_leaf
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.evidence import paint_view

CAMERAS = ring_cameras(6, elevations_deg=(35, 60, 45))
LEAVES = {
    1: flat_leaf(length=1.6, half_width=0.35, at=(-0.8, -0.3, 0.4)),
    2: flat_leaf(length=1.6, half_width=0.4, at=(-0.6, 0.2, 0.0)),
    3: flat_leaf(length=0.8, half_width=0.3, at=(0.4, -0.9, -0.2)),
}


def true_maps(leaves: dict[int, LeafSurface] = LEAVES) -> list[np.ndarray]:
    """V label maps of the leaves."""
    return [paint_view(leaves, CAMERAS, view) for view in range(len(CAMERAS))]


def halved_maps(views: tuple[int, ...]) -> list[np.ndarray]:
    """Something crosses leaf 1, here or there: what lies right of it is 11 in these views, and nothing in others."""
    maps = true_maps()
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    for view, labels in enumerate(maps):
        rays = np.stack([u, v, np.ones_like(u)], -1) @ CAMERAS.world_from_px[view].numpy().T
        x, _, z = CAMERAS.centers[view].tolist()
        on_leaf = x + rays[..., 0] * (0.4 - z) / rays[..., 2]  # where the ray meets the leaf's plane
        is_right = (labels == 1) & (on_leaf > 0.1 * (view % 3 - 1))
        labels[is_right] = 11 if view in views else 0
    return maps
