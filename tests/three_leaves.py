"""Three known leaves and six cameras around them: the first leaf hides a part of the second from above."""

from __future__ import annotations

import numpy as np

from blade_scene import ring_cameras
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
