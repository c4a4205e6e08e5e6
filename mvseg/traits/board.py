"""Which way is up, from ArUco or ChArUco markers that lie flat under or beside the plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.formats.markers import find_scene_markers
from mvseg.reconstruction.triangulate import triangulate_points
from mvseg.scene import Scene

Floats = NDArray[np.float64]

MOST_BEND = 0.1  # smallest spread of the corners over their middle one: they lie in one plane


def up_of_board(scene: Scene) -> Floats:
    """(3,) unit vector up: the normal of the plane of all markers, on the side of the cameras.

    The family of markers with the most corners in space counts.

    Raises:
        InputError: a photo is missing or broken; no marker is seen in two photos, or the markers lie in no one plane.
    """
    found = [triangulate_points(scene.cameras, seen) for seen in find_scene_markers(scene).values()]
    corners = np.array(list(max(found, key=len).values()))
    if not len(corners):
        raise InputError("up is 'board', but no ArUco marker is seen in two photos, expected one that lies flat")
    away = corners - corners.mean(0)
    _, spreads, axes = np.linalg.svd(away, full_matrices=False)
    if spreads[2] > MOST_BEND * spreads[1]:
        raise InputError(f"up is 'board', but the {len(corners)} corners of its markers lie in no one plane")
    towards = scene.cameras.centers.mean(0).cpu().numpy() - corners.mean(0)
    return axes[2] if axes[2] @ towards >= 0 else -axes[2]
