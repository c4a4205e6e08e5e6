"""Where a photo must show the surfaces of the instances, and which of them hide others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class VisibleLeaf:
    """One surface in one view.

    Attributes:
        instance: its id.
        box: x1, y1, x2, y2 of the part of the frame that holds it.
        mask: (y2 - y1, x2 - x1) bool, pixels that it covers and no nearer surface does.
        covered: (y2 - y1, x2 - x1) bool, all pixels that it covers.
        share: of these, that no nearer surface covers.
    """

    instance: int
    box: tuple[int, int, int, int]
    mask: NDArray[np.bool_]
    covered: NDArray[np.bool_]
    share: float


def visible_leaves(surfaces: Mapping[int, LeafSurface], cameras: Cameras, view: int) -> Iterator[VisibleLeaf]:
    """The credible surfaces that one view shows, the nearest first, one at a time in memory.

    A surface is nearer than another as a whole, by the depth of its middle: where two leaves hide parts of each other
    one of them is drawn wrong. Stems and pots hide nothing here. What lies behind the camera or beside the photo is
    left out.

    Args:
        surfaces: {instance id: surface}.
        cameras: V cameras.
        view: index of the view.
    """
    camera = cameras[[view]].to("cpu")
    shown = {instance: surface for instance, surface in surfaces.items() if surface.is_credible}
    if not shown:
        return
    middles = torch.stack([surface.points().reshape(-1, 3).mean(0) for surface in shown.values()])
    _, depth = camera.project(middles)
    width, height = camera.sizes[0].tolist()
    taken = np.zeros((height, width), bool)
    for index in depth[0].argsort(stable=True).tolist():
        instance = list(shown)[index]
        ((x1, y1, x2, y2), covered) = shown[instance].project_parts(camera)[0]
        taken_here = taken[y1:y2, x1:x2]
        mask = covered & ~taken_here
        if mask.any():
            share = float(mask.sum() / covered.sum())
            yield VisibleLeaf(instance=instance, box=(x1, y1, x2, y2), mask=mask, covered=covered, share=share)
        taken_here |= covered
