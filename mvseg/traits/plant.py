"""Traits of a whole plant, from the surfaces of its leaves.

Standard deviations take the errors of different leaves as independent. That of the hull takes as given which points are
the outermost.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import patch_grid
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface, measure_sizes
from mvseg.traits.leaf import UP_UNKNOWN, Measurement, missing
from mvseg.traits.ontology import PLANT_TRAITS

NO_LEAVES = missing("not measured: no leaf has a surface")
FLAT = missing("not measured: the leaves span no volume")
FROM_SURFACES = [trait.name for trait in PLANT_TRAITS[1:]]


def measure_whole(
    surfaces: Mapping[int, LeafSurface], frame: Floats | None, *, num_leaves: int, useless: Collection[int] = ()
) -> dict[str, Measurement]:
    """All of `PLANT_TRAITS`, from the credible surfaces of leaves, by instance id. `frame` has the (3, 3) rows east,
    north, up, None where up is not known; `num_leaves` counts leaves without a surface, too. The total area is without
    `useless` leaves, and its method says which they are, and their area. They count in the height and in the hull,
    which would be too small."""
    numbers = {"number_of_leaves": Measurement(float(num_leaves), float("nan"), "matching")}
    if not surfaces:
        return numbers | dict.fromkeys(FROM_SURFACES, NO_LEAVES)
    counted = {leaf: surface for leaf, surface in surfaces.items() if leaf not in useless}
    numbers |= _measure_surfaces(surfaces, frame, num_leaves=num_leaves)
    if not counted:
        numbers["total_leaf_area"] = missing("not measured: the surface of no leaf is to be used")
    elif len(counted) < len(surfaces):
        area = _measure_surfaces(counted, frame, num_leaves=num_leaves)["total_leaf_area"]
        others = ", ".join(str(leaf) for leaf in sorted(surfaces.keys() - counted.keys()))
        lost = numbers["total_leaf_area"].value - area.value
        numbers["total_leaf_area"] = replace(area, method=f"{area.method}; left out: {lost:.0f} of {others}")
    return {trait.name: numbers[trait.name] for trait in PLANT_TRAITS}


def _measure_surfaces(
    surfaces: Mapping[int, LeafSurface], frame: Floats | None, *, num_leaves: int
) -> dict[str, Measurement]:
    numbers: dict[str, Measurement] = {}
    measure = partial(measure_together, up=None if frame is None else frame[2])
    coefficients = torch.stack([surface.coefficients for surface in surfaces.values()])
    slopes = torch.autograd.functional.jacobian(measure, coefficients).flatten(2)  # (T, N, 78)
    covariance = torch.stack([surface.covariance for surface in surfaces.values()])
    sds = torch.einsum("tni,nij,tnj->nt", slopes, covariance, slopes).clamp(min=0).sqrt().numpy()
    names = ["total_leaf_area", "convex_hull_volume", *(("height",) if frame is not None else ())]
    values = dict(zip(names, measure(coefficients).tolist(), strict=True))
    for place, surface in enumerate(surfaces.values()):
        if surface.occupancy is not None:
            values["total_leaf_area"] += surface.area - measure_sizes(surface.coefficients.numpy())[0]
            sds[place, 0] = surface.deviations[0]
    method = "surface" if len(surfaces) == num_leaves else f"surface ({len(surfaces)} of {num_leaves} leaves)"
    for (name, value), sd in zip(values.items(), np.linalg.norm(sds, axis=0).tolist(), strict=True):
        numbers[name] = Measurement(value, sd, method)
    if not values["convex_hull_volume"] > 0:
        numbers["convex_hull_volume"] = FLAT
    if frame is None:
        numbers["height"] = UP_UNKNOWN
    return numbers


def measure_together(coefficients: Tensor, up: Floats | None) -> Tensor:
    """(2,) area and volume of the hull of leaves whose patches have the coefficients (N, 26, 3); (3,) with the height
    where up is known."""
    points = (torch.from_numpy(patch_grid(*MESH_SHAPE).basis) @ coefficients).unflatten(1, MESH_SHAPE)
    diagonal = points[:, 1:, 1:] - points[:, :-1, :-1]
    sides = (points[:, 1:, :-1] - points[:, :-1, :-1], points[:, :-1, 1:] - points[:, :-1, :-1])
    lower, upper = torch.linalg.cross(sides[0], diagonal), torch.linalg.cross(diagonal, sides[1])
    area = (torch.linalg.vector_norm(lower, dim=-1) + torch.linalg.vector_norm(upper, dim=-1)).sum() / 2
    sizes = [area, hull_volume(points.reshape(-1, 3))]
    if up is not None:
        heights = points @ torch.from_numpy(up)
        sizes.append(heights.max() - heights.min())
    return torch.stack(sizes)


def hull_volume(points: Tensor) -> Tensor:
    """Volume of the convex hull of points (P, 3) float64; 0 for points in one plane."""
    points = points - points.detach().mean(0)  # far from the origin, volumes to it would cancel
    try:
        hull = ConvexHull(points.detach().numpy())
    except QhullError:
        return points.sum() * 0
    first, second, third = points[torch.from_numpy(hull.simplices).long()].unbind(1)
    across = torch.linalg.cross(second - first, third - first)
    outwards = (across.detach() * torch.from_numpy(hull.equations[:, :3])).sum(1).sign()
    return (outwards * (torch.linalg.cross(second, third) * first).sum(1)).sum() / 6
