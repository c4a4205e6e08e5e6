"""A frame of the leaf itself, so that results do not depend on how its world or its photos are turned.

Voxels and pixels have axes. Where masks contradict each other, a start in other voxels may end in another fit. So
voxels lie along directions of the leaf's own cameras, and its photos are turned by quarters, and mirrored, to match.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.arrays import Floats, Ints
from mvseg.reconstruction.numbers import RAYS, STARTS
from mvseg.scene import nearest_point


def find_middle(px_from_world: Floats, px: Floats) -> Floats:
    """(3,) the point nearest to the rays through one pixel (S, 2) of each view."""
    inverse = np.linalg.inv(px_from_world[:, :, :3])
    centers = -(inverse @ px_from_world[:, :, 3:])[..., 0]
    rays = (inverse @ np.append(px, np.ones((len(px), 1)), 1)[..., None])[..., 0]
    return nearest_point(torch.from_numpy(centers), torch.from_numpy(rays)).numpy()


def find_axes(px_from_world: Floats, middle: Floats, areas: Ints) -> Floats:
    """Orthonormal axes (3, 3), in rows, that turn and are mirrored as the world is.

    The first one points to the camera with the largest mask of `areas` (S,), pixels; the others to the camera that is
    farthest from the line, and from the plane, of those before; where there is none, they are at right angles.
    `px_from_world` is (S, 3, 4), `middle` (3,) that of the leaf.
    """
    centers = -np.linalg.solve(px_from_world[:, :, :3], px_from_world[:, :, 3:])[..., 0]
    ways = (centers - middle)[np.argsort(-areas, kind="stable")]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True).clip(min=1e-12)
    first = ways[0]
    second = _farthest(ways - (ways @ first)[:, None] * first)
    if second is None:
        second = _farthest(np.eye(3) - np.outer(first, first))
        assert second is not None
    third = np.cross(first, second)
    found = _farthest((ways @ third)[:, None] * third)
    return np.stack([first, second, third if found is None else found])


def _farthest(vectors: Floats) -> Floats | None:
    lengths = np.linalg.norm(vectors, axis=1)
    index = int((lengths >= lengths.max() - RAYS.tie).argmax())
    return vectors[index] / lengths[index] if lengths[index] > STARTS.flat else None


def find_quarters(px_from_world: Floats, middle: Floats, axes: Floats) -> Ints:
    """(S, 2, 2) of -1, 0 and 1: a turn of each photo by quarters, or its mirror image. Afterwards the longest of the
    axes, as the photo shows it, points to the right rather than up or down, and all photos are mirror images of photos
    with right-handed axes, or none is."""
    cam = px_from_world[:, :, :3] @ middle + px_from_world[:, :, 3]
    matrix = px_from_world[:, :, :3] @ axes.T
    # (S, 2, 3) the axes, as photos show them.
    shown = matrix[:, :2] - cam[:, :2, None] / cam[:, 2:, None] * matrix[:, 2:]
    lengths = np.linalg.norm(shown, axis=1)
    longest = (lengths >= lengths.max(1, keepdims=True) * (1 - RAYS.tie)).argmax(1)
    x, y = shown[np.arange(len(shown)), :, longest].T * np.sign(cam[:, 2])
    is_level = np.abs(x) >= np.abs(y)
    cosine, sine = np.where(is_level, np.sign(x), 0), np.where(is_level, 0, np.sign(y))
    quarters = np.stack([np.stack([cosine, sine], 1), np.stack([-sine, cosine], 1)], 1)
    quarters[:, 1] *= np.sign(np.linalg.det(matrix))[:, None]
    return quarters.astype(np.int64)


def turn_pixels(pixels: NDArray, quarter: Ints) -> NDArray:
    """A photo, label frame or mask (H, W), turned; it shares its memory."""
    turned = pixels if quarter[0, 0] else pixels.T
    down, right = (slice(None, None, int(quarter[row].sum())) for row in (1, 0))
    return turned[down, right]


def turn_matrix(quarter: Ints, size: tuple[int, int]) -> Floats:
    """(3, 3) from the pixels of a photo of `size` (width, height) to those of the turned one."""
    matrix = np.eye(3)
    matrix[:2, :2] = quarter
    matrix[:2, 2] = np.maximum(0, -quarter @ size)
    return matrix
