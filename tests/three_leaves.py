"""Three known leaves and six cameras around them: the first leaf hides a part of the second from above."""

from __future__ import annotations

import numpy as np

from blade_scene import SIZE, ring_cameras
from known_leaves import flat_leaf
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.visible_leaves import visible_leaves

CAMERAS = ring_cameras(6, elevations_deg=(35, 60, 45))
LEAVES = {
    1: flat_leaf(length=1.6, half_width=0.35, at=(-0.8, -0.3, 0.4)),
    2: flat_leaf(length=1.6, half_width=0.4, at=(-0.6, 0.2, 0.0)),
    3: flat_leaf(length=0.8, half_width=0.3, at=(0.4, -0.9, -0.2)),
}


def true_maps(leaves: dict[int, LeafSurface] = LEAVES) -> list[np.ndarray]:
    """V label maps of the leaves."""
    maps = []
    for view in range(len(CAMERAS)):
        labels = np.zeros((SIZE, SIZE), np.int64)
        for leaf in visible_leaves(leaves, CAMERAS, view):
            x1, y1, x2, y2 = leaf.box
            labels[y1:y2, x1:x2][leaf.mask] = leaf.instance
        maps.append(labels)
    return maps
