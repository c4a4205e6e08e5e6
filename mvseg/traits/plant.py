"""Traits of a whole plant, from the surfaces of its leaves.

Standard deviations take the errors of different leaves as independent. Those of hull and projected area take as given
which points and cells are the outermost.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from mvseg.reconstruction.surface.leaf_patch import patch_grid
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface, cell_normals
from mvseg.traits.from_above import Cells
from mvseg.traits.leaf import UP_UNKNOWN, Measurement, missing
from mvseg.traits.ontology import PLANT_TRAITS

Floats = NDArray[np.float64]

NO_LEAVES = missing("not measured: no leaf has a surface")
FLAT = missing("not measured: the leaves span no volume")
NEED_UP = ("height", "projected_area", "light_interception")
FROM_SURFACES = [trait.name for trait in PLANT_TRAITS[1:]]
DECILES = FROM_SURFACES[-9:]


def measure_whole(
    surfaces: Mapping[int, LeafSurface], cells: Mapping[int, Cells], frame: Floats | None, *, num_leaves: int
) -> dict[str, Measurement]:
    """All of `PLANT_TRAITS`, from the credible surfaces of leaves, by instance id, and their cells (`look_from_above`).

    `frame` (3, 3) has the rows east, north, up, None where up is not known; `num_leaves` counts those without a
    surface, too.
    """
    numbers = {"number_of_leaves": Measurement(float(num_leaves), float("nan"), "matching")}
    if not surfaces:
        return numbers | dict.fromkeys(FROM_SURFACES, NO_LEAVES)
    grids = np.stack([surface.points().numpy() for surface in surfaces.values()])  # (N, rows, columns, 3)
    areas = np.array([surface.area for surface in surfaces.values()])
    volume, hull_slopes = hull_volume(grids)
    values = {"total_leaf_area": areas.sum(), "convex_hull_volume": volume}
    slopes = [hull_slopes]
    if frame is not None:
        covered = sum(cells[instance].projected_area for instance in surfaces)
        height, height_slopes = height_of(grids, frame[2])
        slopes.append(height_slopes)
        values |= {"height": height, "projected_area": covered, "light_interception": min(covered / areas.sum(), 1.0)}

    sds = []
    for index, (instance, surface) in enumerate(surfaces.items()):
        normals = cell_normals(grids[index])
        unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True).clip(min=1e-300)
        by_area = slopes_of_grid(grids[index], unit)
        by_point = [by_area, *(slope[index] for slope in slopes)]
        if frame is not None:
            is_lit, up = cells[instance].is_lit, frame[2]
            by_shown = slopes_of_grid(grids[index], np.sign(normals @ up)[..., None] * is_lit[..., None] * up)
            by_point += [by_shown, (by_shown - values["light_interception"] * by_area) / areas.sum()]
        moves = np.stack(by_point).reshape(len(by_point), -1, 3)
        by_coefficient = np.einsum("tpc,pb->tbc", moves, patch_grid(*MESH_SHAPE).basis).reshape(len(by_point), -1)
        variance = np.einsum("ij,jk,ik->i", by_coefficient, surface.covariance.numpy(), by_coefficient)
        sds.append(np.sqrt(np.maximum(variance, 0)))
    together = np.sqrt(np.square(sds).sum(0))
    method = "surface" if len(surfaces) == num_leaves else f"surface ({len(surfaces)} of {num_leaves} leaves)"
    for (name, value), sd in zip(values.items(), together.tolist(), strict=True):
        numbers[name] = Measurement(float(value), sd, method)
    if not volume > 0:
        numbers["convex_hull_volume"] = FLAT
    if frame is None:
        numbers |= dict.fromkeys(NEED_UP, UP_UNKNOWN)
    return numbers | area_deciles(areas, np.array(sds)[:, 0], method=method)


def slopes_of_grid(points: Floats, by_normal: Floats) -> Floats:
    """(rows, columns, 3) derivatives by the points of a grid, of what has the derivatives `by_normal` (rows - 1,
    columns - 1, 3) by its `cell_normals`."""
    along, across = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    by_along, by_across = np.cross(across, by_normal) / 2, np.cross(by_normal, along) / 2
    slopes = np.zeros_like(points)
    slopes[1:, 1:] += by_along
    slopes[:-1, :-1] -= by_along
    slopes[1:, :-1] += by_across
    slopes[:-1, 1:] -= by_across
    return slopes


def area_deciles(areas: Floats, sds: Floats, *, method: str) -> dict[str, Measurement]:
    """The nine deciles of the areas (N,) of N >= 1 leaves, interpolated linearly between them."""
    order = np.argsort(areas, kind="stable")
    numbers = {}
    for name, share in zip(DECILES, np.arange(1, 10) / 10, strict=True):
        place = share * (len(areas) - 1)
        weights = np.clip(1 - np.abs(np.arange(len(areas)) - place), 0, None)
        value, sd = weights @ areas[order], np.linalg.norm(weights * sds[order])
        numbers[name] = Measurement(float(value), float(sd), method)
    return numbers


def hull_volume(points: Floats) -> tuple[float, Floats]:
    """Volume of the convex hull of points (..., 3), and its derivatives by them, of the same shape.

    Both are 0 for points in one plane.
    """
    flat = points.reshape(-1, 3)
    slopes = np.zeros_like(flat)
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return 0.0, slopes.reshape(points.shape)
    corners = flat[hull.simplices]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = np.sign((across * hull.equations[:, :3]).sum(1))
    for index in range(3):
        opposite = np.cross(corners[:, (index + 1) % 3], corners[:, (index + 2) % 3])
        np.add.at(slopes, hull.simplices[:, index], outwards[:, None] * opposite / 6)
    return float(hull.volume), slopes.reshape(points.shape)


def height_of(points: Floats, up: Floats) -> tuple[float, Floats]:
    """Extent of points (..., 3) along up, and its derivatives by them."""
    heights = points @ up
    slopes = np.zeros_like(points)
    slopes[np.unravel_index(heights.argmax(), heights.shape)] += up
    slopes[np.unravel_index(heights.argmin(), heights.shape)] -= up
    return float(np.ptp(heights)), slopes
