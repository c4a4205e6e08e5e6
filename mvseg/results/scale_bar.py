"""A scale bar for a photo: a round length, as long as it looks at the plant's distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mvseg.results.result import Result

if TYPE_CHECKING:
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid

STEPS = (1, 2, 5)  # definition: round lengths, times powers of ten
MOST = 0.2  # definition: max. length of a bar, as a share of the photo's width


@dataclass(frozen=True)
class ScaleBar:
    """A bar with its length.

    Attributes:
        share: its length, as a share of the photo's width, in (0, 0.2].
        text: the length in the world, with its unit.
    """

    share: float
    text: str


def fit_scale_bars(result: Result) -> list[ScaleBar | None]:
    """One per view, for the median depth of the leaves' shapes; what is nearer to the camera looks larger.

    None where the unit of the world is not known, no leaf has a shape, or the plant is behind the camera.
    """
    cameras = result.scene.cameras.to("cpu")
    bars: list[ScaleBar | None] = [None] * len(cameras)
    if not result.scene.unit or not (result.surfaces or result.voxels):
        return bars
    from mvseg.reconstruction.shapes import best_shape

    leaves = range(1, result.matching.num_instances + 1)
    middles = [_middle(shape) for leaf in leaves if (shape := best_shape(leaf, result.surfaces, result.voxels))]
    if not middles:
        return bars
    middle = torch.stack(middles).median(0).values
    for view, depth in enumerate((cameras.R[:, 2] @ middle + cameras.t[:, 2]).tolist()):
        if depth > 0:
            width_in_units = float(cameras.sizes[view, 0] / cameras.K[view, 0, 0]) * depth
            length = round_length(MOST * width_in_units)
            bars[view] = ScaleBar(share=length / width_in_units, text=f"{length:g} {result.scene.unit}")
    return bars


def _middle(shape: LeafSurface | VoxelGrid) -> Tensor:
    points = shape.points if isinstance(shape.points, Tensor) else shape.points()
    return points.reshape(-1, 3).cpu().mean(0)


def round_length(most: float) -> float:
    """The largest length of 1, 2 or 5 times a power of ten that is at most `most`, which is above 0."""
    power = 10 ** math.floor(math.log10(most))
    return max(step * power for step in STEPS if step * power <= most)
