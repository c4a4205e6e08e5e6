"""Points in space from their pixels in several views."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import RAYS
from mvseg.scene import Cameras

Key = TypeVar("Key", bound=Hashable)


def triangulate_points(cameras: Cameras, sightings: Mapping[Key, Sequence[tuple[int, Floats]]]) -> dict[Key, Floats]:
    """Points that two views or more agree on, {point: (3,) world coordinates}, from `sightings` {point: (view, (2,)
    pixels)}, at most once in a view. Points seen in a single view, or not within `RAYS.most_error` in each, are left
    out, and so are those whose rays are all nearly parallel."""
    centers, sizes = cameras.centers.cpu().numpy(), cameras.sizes.cpu().numpy()
    px_from_world = cameras.px_from_world.cpu().numpy()
    points: dict[Key, Floats] = {}
    for key, places in sightings.items():
        views = [view for view, _ in places]
        if len(set(views)) < 2 or len(set(views)) < len(views):
            continue
        px = np.stack([place for _, place in places])
        point = triangulate(px_from_world[views], px)
        image = px_from_world[views] @ np.append(point, 1.0)
        error = np.linalg.norm(image[:, :2] / image[:, 2:] - px, axis=1)
        rays = point - centers[views]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        is_steady = bool((rays @ rays.T).min() < np.cos(RAYS.least_angle))
        if is_steady and (error < RAYS.most_error * sizes[views, 0]).all():
            points[key] = point
    return points


def triangulate(px_from_world: Floats, px: Floats) -> Floats:
    """(3,) point of S views with matrices (S, 3, 4) and pixels (S, 2): linear least squares."""
    rows = px[:, :, None] * px_from_world[:, 2:] - px_from_world[:, :2]
    rows = (rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)).reshape(-1, 4)
    return np.asarray(np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0], dtype=float)
