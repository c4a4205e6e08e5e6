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
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface
from mvseg.traits.from_above import Cells
from mvseg.traits.leaf import UP_UNKNOWN, Measurement, cell_normals, missing
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
        is_lit = None if frame is None else cells[instance].is_lit

        def measure(moved: Floats, index: int = index, is_lit: NDArray[np.bool_] | None = is_lit) -> Floats:
            grid = patch_grid(*MESH_SHAPE).points(moved)
            normals = cell_normals(grid)
            area = np.linalg.norm(normals, axis=-1).sum()
            parts = [area, *((slope[index] * grid).sum() for slope in slopes)]
            if frame is not None and is_lit is not None:
                shown = np.abs(normals[is_lit] @ frame[2]).sum()
                parts += [shown, (shown - values["light_interception"] * area) / areas.sum()]
            return np.array(parts)

        sds.append(surface.deviation(measure))
    together = np.sqrt(np.square(sds).sum(0))
    method = "surface" if len(surfaces) == num_leaves else f"surface ({len(surfaces)} of {num_leaves} leaves)"
    for (name, value), sd in zip(values.items(), together.tolist(), strict=True):
        numbers[name] = Measurement(float(value), sd, method)
    if not volume > 0:
        numbers["convex_hull_volume"] = FLAT
    if frame is None:
        numbers |= dict.fromkeys(NEED_UP, UP_UNKNOWN)
    return numbers | area_deciles(areas, np.array(sds)[:, 0], method=method)


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
