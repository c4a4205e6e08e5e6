"""Some of many views, evenly spread by direction around the point that the cameras look at.

They are chosen as electric charges would settle: no exchange of one view lowers the sum of 1 / d^2 over all pairs of
chosen directions, d their distance on the unit sphere.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.reconstruction.numbers import RAYS
from mvseg.scene import Cameras, nearest_point


def spread_views(cameras: Cameras, most: int) -> Tensor:
    """The indices (S,) int64, ascending, of at most `most` >= 1 views.

    The cameras look at the point nearest to their optical axes; where these are parallel, at a point as far ahead as
    the cameras are apart. Distances from it play no part. The order of the views only decides between equally even
    choices.
    """
    return torch.from_numpy(spread_directions(_directions(cameras.to("cpu")), most))


def find_repeated(cameras: Cameras) -> Tensor:
    """(V,) bool: views from the place of an earlier one, with the same optical axis: within `RAYS.repeated` as seen
    from what the cameras look at. None of two or fewer."""
    is_repeated = torch.zeros(len(cameras), dtype=torch.bool)
    if len(cameras) > 2:
        cameras, least = cameras.to("cpu"), math.cos(RAYS.repeated)
        ways, axes = torch.from_numpy(_directions(cameras)), cameras.R[:, 2]
        is_same = (ways @ ways.T > least) & (axes @ axes.T > least)
        for view in range(1, len(cameras)):
            is_repeated[view] = (is_same[view, :view] & ~is_repeated[:view]).any()
    return is_repeated


def spread_directions(ways: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """The same for unit directions (V, 3) from the object to the cameras."""
    if len(ways) <= most:
        return np.arange(len(ways))
    crowding = 1 / (((ways[:, None] - ways[None]) ** 2).sum(2) + RAYS.same**2)
    np.fill_diagonal(crowding, 0)
    return np.flatnonzero(_exchange(crowding, _drop(crowding, most)))


def _directions(cameras: Cameras) -> NDArray[np.float64]:
    axes, centers = cameras.R[:, 2], cameras.centers
    mean_axis, middle = axes.mean(0), centers.mean(0)
    if 1 - mean_axis @ mean_axis < RAYS.parallel**2:
        target = middle + mean_axis * (centers - middle).norm(dim=1).square().mean().sqrt()
    else:
        target = nearest_point(centers, axes)
    return np.asarray(torch.nn.functional.normalize(centers - target, dim=1).numpy())


def _drop(crowding: NDArray[np.float64], most: int) -> NDArray[np.bool_]:
    chosen = np.ones(len(crowding), bool)
    load = crowding.sum(1)
    while chosen.sum() > most:
        goes = _first_least(np.where(chosen, -load, np.inf))
        chosen[goes] = False
        load -= crowding[goes]
    return chosen


def _exchange(crowding: NDArray[np.float64], is_taken: NDArray[np.bool_]) -> NDArray[np.bool_]:
    is_taken = is_taken.copy()
    while True:
        load = crowding @ is_taken
        inside, outside = np.flatnonzero(is_taken), np.flatnonzero(~is_taken)
        change = load[outside] - load[inside, None] - crowding[np.ix_(inside, outside)]
        if change.min() >= -RAYS.tie * load[inside].sum():
            return is_taken
        goes, comes = np.unravel_index(_first_least(change.ravel()), change.shape)
        is_taken[inside[goes]], is_taken[outside[comes]] = False, True


def _first_least(values: NDArray[np.float64]) -> int:
    least = values.min()
    return int(np.flatnonzero(values <= least + RAYS.tie * abs(least))[0])
