"""Fits of surfaces by all their inputs: own masks, masks that may hide the leaf, cameras, start and numbers.

The fits are pure functions of these, so a cache changes no bit of a result, whatever was fitted before.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.reconstruction import numbers
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.mask_errors import MaskErrors
from mvseg.reconstruction.surface.mask_stack import FRAME, MaskStack

Cache = dict[str, Any]  # {digest of all inputs: answer}
ORIENTED = "oriented"  # definition: first word of the names of surfaces that are there a second time


@dataclass(frozen=True, eq=False)
class Approach:
    """The first fit of a leaf; the second one begins there.

    Attributes:
        views: (S,) int64, the views whose masks show the leaf.
        coefficients: (26, 3) float64 of the patch.
        offsets_px: (S,) float64, by how much each mask is too large; NaN where none of its edges was met.
        spread: deviation of the areas of other fits that are as good, as a share of its own.
    """

    views: Tensor
    coefficients: Tensor
    offsets_px: Tensor
    spread: float


def reuse_object(cache: Cache, name: str, surface: LeafSurface) -> LeafSurface:
    """The surface as it is oriented; the object of an earlier call, which remembers its image, where both are equal."""
    how = f"{ORIENTED} {name} {surface.is_oriented} {_digest(surface.coefficients.numpy())}"
    oriented: LeafSurface = cache.setdefault(how, surface)
    return oriented


def name_first(masks: MaskStack, start: Floats | None) -> str:
    """Digest of all that a first fit follows from. Of other instances it is told where they are, not which they are."""
    hidden = np.where(masks.others == FRAME, 2, masks.others != 0).astype(np.uint8)
    parts = masks.views, masks.px_from_world, masks.blurred, masks.inside, hidden, masks.axes
    scaled = [value for name, value in vars(numbers).items() if name.isupper()]
    return _digest(*parts, *([] if start is None else [start])) + f" {masks.pixel_size} {scaled}"


def name_second(
    name: str,
    masks: MaskStack,
    approach: Approach,
    others: Mapping[int, Floats],
    *,
    errors: MaskErrors | None,
) -> str:
    """Digest of all inputs of a second fit; ids of `others` {instance id: points of its grid} do not matter."""
    hiding = sorted(_digest(points, masks.others == other) for other, points in others.items())
    of_all = [] if errors is None else [errors.density, np.array(errors.sd_px)]
    found = approach.views, approach.coefficients, approach.offsets_px
    return " ".join([name, _digest(*(each.numpy() for each in found), np.array(approach.spread), *of_all), *hiding])


def _digest(*arrays: NDArray) -> str:
    digest = hashlib.sha256()
    for each in arrays:
        digest.update(f"{each.shape} {each.dtype}".encode())
        digest.update(np.ascontiguousarray(each).tobytes())
    return digest.hexdigest()
