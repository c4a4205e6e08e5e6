"""The axis of a stem in photos: the cheapest path through thin cells from the lowest leaf to the highest one.

Petioles, the cheapest paths from anywhere on the leaves' surfaces, join leaves to it. So a midrib that runs the wrong
way, as on leaves that are wider than long, does no harm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import AXES, THIN
from mvseg.reconstruction.stem.thin_parts import ThinCells


@dataclass(frozen=True, eq=False)
class StemPath:
    """A line of thin cells that several leaves are joined to: (P, 3) smooth from one end to the other, the side of a
    cell, and the petioles {leaf: (n, 3) from the line to the leaf}, n >= 1."""

    points: Floats
    cell: float
    petioles: Mapping[int, Floats]


def find_path(cells: ThinCells, leaves: Mapping[int, Floats]) -> StemPath | None:
    """Find the line of cells through which the cheapest paths between the `leaves` {leaf: (P, 3) points on its surface}
    run. None where fewer than `AXES.least_leaves` leaves are joined, or their paths share no line."""
    if len(cells.points) < THIN.least_steps or len(leaves) < AXES.least_leaves:
        return None
    graph, num_cells = _join_cells(cells, leaves), len(cells.points)
    places = np.arange(num_cells, num_cells + len(leaves))
    every, before = dijkstra(graph, directed=False, indices=places, return_predecessors=True)
    cost = every[:, num_cells:]
    joined = np.isfinite(cost).sum(1)
    root = int(np.lexsort((np.where(np.isfinite(cost), cost, 0).sum(1), -joined))[0])
    if joined[root] < AXES.least_leaves:
        return None
    points = _fit_line(cells, _find_trunk(before[root], num_cells))
    return None if points is None else StemPath(points, cells.size, _find_petioles(graph, cells, leaves, points))


def _find_trunk(before: NDArray, num_cells: int) -> NDArray[np.int64]:
    """(cells,) of the cheapest paths between leaves, how many lead through a cell, or do not, the fewer. `before` has
    the place before each on its path from one of the leaves."""
    used = np.zeros(len(before), np.int64)
    joined = num_cells + np.flatnonzero(before[num_cells:] >= 0)
    for leaf in joined.tolist():
        used[trace_path(before, leaf)] += 1
    cells, num = used[:num_cells], len(joined) + 1
    return np.asarray(np.maximum(np.minimum(cells, num - cells), 1) - 1)


def _fit_line(cells: ThinCells, trunk: NDArray[np.int64]) -> Floats | None:
    """(P, 3) a smooth line along the cells of a trunk; None where they lie on none."""
    members = np.flatnonzero(trunk > 0)
    if len(members) < THIN.least_steps:
        return None
    points, weight = cells.points[members], trunk[members].astype(float)
    few = points[np.linspace(0, len(points) - 1, min(len(points), THIN.line_ends)).astype(int)]
    first, second = np.triu_indices(len(few), 1)
    ahead = few[second] - few[first]
    length = np.linalg.norm(ahead, axis=1)
    first, ahead = first[length > 0], (ahead / np.maximum(length, 1e-300)[:, None])[length > 0]
    away = points[None] - few[first][:, None]
    along = (away * ahead[:, None]).sum(2)
    gap = np.sqrt(np.maximum((away**2).sum(2) - along**2, 0))
    near = THIN.line_cells * cells.size
    best = int((weight / (1 + (gap / near) ** 2)).sum(1).argmax())
    along, gap, origin, ahead = along[best], gap[best], few[first[best]], ahead[best]
    target = points - origin - along[:, None] * ahead
    for _ in range(THIN.line_rounds):
        robust = weight / (1 + (gap / near) ** 2)
        close = gap < 2 * near
        scale = max(float(np.ptp(along[close])), 1e-300) if close.any() else 1.0
        middle = float(along[close].mean()) if close.any() else 0.0
        t = (along - middle) / scale
        rows = np.stack([np.ones_like(t), t, t**2], 1)
        system = (rows.T * robust) @ rows + np.diag([1e-9, 1e-9, THIN.bend_cost * weight.mean()])
        bend = np.linalg.solve(system, (rows.T * robust) @ target)
        gap = np.linalg.norm(target - rows @ bend, axis=1)
    close = gap < 2 * near
    if close.sum() < THIN.least_steps or np.ptp(along[close]) < THIN.least_steps * cells.size:
        return None
    even = (np.linspace(along[close].min(), along[close].max(), AXES.points) - middle) / scale
    line = origin + (even * scale + middle)[:, None] * ahead
    return np.asarray(line + np.stack([np.ones_like(even), even, even**2], 1) @ bend)


def _find_petioles(
    graph: csr_matrix, cells: ThinCells, leaves: Mapping[int, Floats], line: Floats
) -> dict[int, Floats]:
    """{leaf: (n, 3) the cheapest path from the line, or from where it goes on beyond its ends, to the leaf}."""
    ends = np.array([[line[0], line[3]], [line[-1], line[-4]]])
    ahead = ends[:, 0] - ends[:, 1]
    ahead *= THIN.line_beyond * np.linalg.norm(line[-1] - line[0]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    beyond = ends[:, 0] + np.linspace(0, 1, AXES.points)[1:, None, None] * ahead
    gap, place = cKDTree(np.concatenate([line, beyond.reshape(-1, 3)])).query(cells.points)
    away = np.linalg.norm(np.concatenate([line * 0, np.abs(beyond - ends[:, 0]).reshape(-1, 3)]), axis=1)[place]
    sources = np.flatnonzero(gap < THIN.line_cells * cells.size + THIN.cone * away)  # the stem may bend there
    if not len(sources):
        return {}
    cost, before, _ = dijkstra(graph, directed=False, indices=sources, min_only=True, return_predecessors=True)
    petioles = {}
    for index, leaf in enumerate(leaves, start=len(cells.points)):
        if np.isfinite(cost[index]):
            way = [place for place in trace_path(before, index) if place < len(cells.points)]
            end = leaves[leaf][cKDTree(leaves[leaf]).query(cells.points[way[-1]])[1]]
            petioles[leaf] = np.concatenate([cells.points[way], end[None]])
    return petioles


def trace_path(before: NDArray, end: int) -> list[int]:
    """Places from a source of `dijkstra` to an end."""
    way = [end]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return way[::-1]


def _spread_cells(cells: ThinCells) -> NDArray:
    cube = np.floor((cells.points - cells.points.min(0)) / (THIN.cube_cells * cells.size)).astype(int)
    order = np.lexsort((np.arange(len(cube)), -cells.share))
    _, first = np.unique(cube[order], axis=0, return_index=True)
    return order[first]


def _join_cells(cells: ThinCells, leaves: Mapping[int, Floats]) -> csr_matrix:
    """Costs of steps between cells, and to leaves, which come after the cells; a leaf is next to all cells near it."""
    near = cKDTree(cells.points).query_pairs(THIN.gap_cells * cells.size, output_type="ndarray")
    # Leaves hide parts of a stem: long steps between a few cells lead across.
    few = _spread_cells(cells)
    far = few[cKDTree(cells.points[few]).query_pairs(THIN.bridge_cells * cells.size, output_type="ndarray")]
    pairs = np.concatenate([near, far])
    length = np.linalg.norm(cells.points[pairs[:, 0]] - cells.points[pairs[:, 1]], axis=1) / cells.size
    # A gap costs more than its length, and cells that views doubt more than sure ones.
    doubt = 1 + THIN.doubt_cost * (1 - cells.share[pairs].mean(1))
    weight = [length**THIN.gap_power * doubt]
    rows, columns = [pairs[:, 0]], [pairs[:, 1]]
    for index, points in enumerate(leaves.values(), start=len(cells.points)):
        gap, _ = cKDTree(points).query(cells.points, distance_upper_bound=THIN.touch_cells * cells.size)
        near = np.flatnonzero(np.isfinite(gap))
        rows.append(np.full(len(near), index))
        columns.append(near)
        weight.append(THIN.touch_cost + (gap[near] / cells.size) ** THIN.gap_power)
    size = len(cells.points) + len(leaves)
    steps = np.concatenate(weight), (np.concatenate(rows), np.concatenate(columns))
    return coo_matrix(steps, (size, size)).tocsr()
