"""The hull of one leaf's masks as a cloud of voxels: where a fit may start."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mvseg.reconstruction.surface.leaf_patch import Floats, Ints
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.patch_image import project_points

SHOWN_SHARE = 0.5  # a voxel is occupied if it is in more than this share of the masks
SEEN_SHARE = 0.8  # no view looks past a voxel if more than this share of those that nothing hides it from show it
CELL_PX = 6.0  # the search ends when the side of a cell is less than this in the photos
MOST_CELLS = 10_000  # or when there are so many cells (a technical limit)
NUM_VOXELS = 20_000  # about so many voxels are looked at in these cells (a technical limit)


@dataclass(frozen=True, eq=False)
class Hull:
    """Voxels (P, 3), whole numbers; voxel (a, b, c) has its centre at corner + size * (a + 0.5, b + 0.5, c + 0.5).

    Attributes:
        voxels: that more than half of the masks show.
        is_seen: (P,) bool, of these, that no view looks past; where faulty masks make that too strict, none.
        corner: (3,) in the world.
        size: of a voxel.
    """

    voxels: Ints
    is_seen: NDArray[np.bool_]
    corner: Floats
    size: float

    @property
    def points(self) -> Floats:
        """(P, 3) their centres."""
        return self.corner + self.size * (self.voxels + 0.5)


def carve_hull(masks: MaskStack) -> Hull:
    """The voxels that most masks of a leaf show, from an octree.

    A cube about the point nearest to all masks, twice as far as the farthest camera, is halved again and again; cells
    that no point of half of the masks can lie in are left out. Cells are judged by the balls around them, so nothing
    is lost, however thin. Masks of nearly parallel views may share an unbounded space: it ends at the cube.
    """
    matrices = masks.px_from_world
    centres = np.asarray(-np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0], dtype=float)
    middle = _nearest_point(masks, centres)
    size = 4 * float(np.linalg.norm(centres - middle, axis=1).max())
    corner = middle - size / 2
    ball = _Balls(masks, centres)
    cells = np.zeros((1, 3), np.int64)
    enough = CELL_PX * float(np.median(np.linalg.norm(centres - middle, axis=1) / ball.focal))
    while 0 < len(cells) < MOST_CELLS and size > enough:
        size /= 2
        cells = _divide(cells, 2)
        votes = ball.may_meet(corner + size * (cells + 0.5), size * 0.75**0.5).sum(0)
        cells = cells[votes > SHOWN_SHARE * len(masks)]
    parts = max(1, round((NUM_VOXELS / max(len(cells), 1)) ** (1 / 3)))
    size, voxels = size / parts, _divide(cells, parts)
    inside, free = look_at(masks, corner + size * (voxels + 0.5))
    votes = inside.sum(0)
    is_shown = votes > SHOWN_SHARE * len(masks)
    is_seen = votes > SEEN_SHARE * (votes + free.sum(0)) + 1e-6
    return Hull(voxels=voxels[is_shown], is_seen=is_seen[is_shown], corner=corner, size=size)


def _divide(cells: Ints, parts: int) -> Ints:
    """Cells (P, 3), each side in so many parts."""
    return (parts * cells[:, None] + np.array(list(product(range(parts), repeat=3)))).reshape(-1, 3)


def look_at(masks: MaskStack, points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(S, P) bool, is a point (P, 3) in the mask of a view, and does that view show nothing where it is?"""
    image = project_points(masks.px_from_world, points[None])
    stack = np.repeat(np.arange(len(masks)), len(points))
    px = image.px.reshape(-1, 2)
    inside = masks.look_up(masks.inside, stack, px)
    free = ~inside & (masks.look_up(masks.others, stack, px) == 0)
    return inside.reshape(len(masks), -1), free.reshape(len(masks), -1)


def _nearest_point(masks: MaskStack, centres: Floats) -> Floats:
    """(3,) the point nearest to the rays through the middles of the masks; of parallel rays, one of many."""
    rows, columns = np.arange(masks.size[0]) + 0.5, np.arange(masks.size[1]) + 0.5
    x, y = masks.inside.sum(1) @ columns, masks.inside.sum(2) @ rows
    middles = np.stack([x, y, masks.inside.sum((1, 2))], 1)
    rays = np.linalg.solve(masks.px_from_world[:, :, :3], middles[..., None])[..., 0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    start = centres.mean(0)  # far from the world's origin the products would cancel
    target = (across @ (centres - start)[..., None]).sum(0)[:, 0]
    nearest: Floats = start + np.linalg.pinv(across.sum(0), rcond=1e-9) @ target
    return nearest


class _Balls:
    """Which masks can balls in the world meet?

    The projection of a ball is replaced by a square of pixels that contains it, so the answer errs only towards True.
    """

    def __init__(self, masks: MaskStack, centres: Floats) -> None:
        self.masks, self.centres = masks, centres
        rows = masks.px_from_world[:, :, :3]
        axis = rows[:, 2:]
        self.focal = np.linalg.norm(rows[:, :2] - (rows[:, :2] @ axis.transpose(0, 2, 1)) * axis, axis=2).max(1)
        height, width = masks.size
        corners = np.array([(x, y, 1.0) for x in (0, width) for y in (0, height)]).T
        self.slant = np.linalg.norm(np.linalg.solve(rows, np.broadcast_to(corners, (len(rows), 3, 4))), axis=1).max(1)
        self.integral = np.zeros((len(masks), height + 1, width + 1), np.int32)
        masks.inside.cumsum(1, dtype=np.int32).cumsum(2, out=self.integral[:, 1:, 1:])

    def may_meet(self, points: Floats, radius: float) -> NDArray[np.bool_]:
        """(S, P) bool, of balls about points (P, 3)."""
        image = project_points(self.masks.px_from_world, points[None])
        depth = (self.masks.px_from_world[:, 2, :3] @ points.T) + self.masks.px_from_world[:, 2, 3:]
        distance = np.linalg.norm(points - self.centres[:, None], axis=2)
        # |u' - u| <= f r sqrt(1 + (X / Z)^2) / (Z - r), and distance / depth is the root, or more
        is_ahead = depth > radius
        ahead = np.where(is_ahead, depth, 2 * radius)
        margin = radius * self.focal[:, None] / (ahead - radius) * distance / ahead
        sides = self.masks.size[::-1]
        low = np.clip(np.floor(image.px[:, 0] - margin[..., None]), 0, sides).astype(np.int64)
        high = np.clip(np.floor(image.px[:, 0] + margin[..., None]) + 1, 0, sides).astype(np.int64)
        width, (view, flat) = sides[0] + 1, (np.arange(len(self.centres))[:, None], self.integral.ravel())
        top, bottom = ((view * (sides[1] + 1) + edge[..., 1]) * width for edge in (low, high))
        left, right = low[..., 0], high[..., 0]
        count = flat[bottom + right] - flat[top + right] - flat[bottom + left] + flat[top + left]
        # What reaches behind a camera has no bounded image. A point of the mask in it has a depth below 2 r, thus
        # lies within 2 r slant of the camera, and the ball's centre within r of that.
        beside = (depth > -radius) & (distance <= radius * (1 + 2 * self.slant[:, None]))
        return np.where(is_ahead, count > 0, beside)
