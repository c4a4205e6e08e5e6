"""The hull of one leaf's masks as a cloud of voxels: where a fit may start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.arrays import Floats, Ints
from mvseg.reconstruction.numbers import HULL
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.patch_image import project_points
from mvseg.reconstruction.visual_hull import Silhouettes, halve_cells


@dataclass(frozen=True, eq=False)
class Hull:
    """Voxels (P, 3), whole numbers, that more than half of the masks show; voxel (a, b, c) has its centre at corner +
    size * (a + 0.5, b + 0.5, c + 0.5).

    Attributes:
        is_seen: (P,) bool, voxels that no view looks past; none where faulty masks make that too strict.
        corner: (3,) in the world.
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
    """The voxels that most masks of a leaf show, from an octree; for nearly parallel views see `halve_cells`."""
    silhouettes = Silhouettes(tuple(torch.from_numpy(masks.inside)), torch.from_numpy(masks.px_from_world))
    enough = HULL.cell_px * float((silhouettes.distances / silhouettes.focal).quantile(0.5))
    for cells in halve_cells(silhouettes, HULL.shown_share):
        if not 0 < len(cells) < HULL.most_cells or cells.size <= enough:
            break
    cells = cells.divide(max(1, round((HULL.num_voxels / max(len(cells), 1)) ** (1 / 3))))
    voxels, corner, size = cells.indices.numpy(), cells.corner.numpy(), cells.size
    inside, free = locate_points(masks, corner + size * (voxels + 0.5))
    votes = inside.sum(0)
    is_shown = votes > HULL.shown_share * len(masks)
    is_seen = votes > HULL.seen_share * (votes + free.sum(0)) + 1e-6
    return Hull(voxels=voxels[is_shown], is_seen=is_seen[is_shown], corner=corner, size=size)


def locate_points(masks: MaskStack, points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(S, P) bool, is a point (P, 3) in the mask of a view, and does that view show nothing where it is?"""
    image = project_points(masks.px_from_world, points[None])
    stack = np.repeat(np.arange(len(masks)), len(points))
    px = image.px.reshape(-1, 2)
    place = masks.place_of(stack, px)
    inside = masks.inside.ravel().take(place)
    free = ~inside & (masks.others.ravel().take(place) == 0)
    return inside.reshape(len(masks), -1), free.reshape(len(masks), -1)
