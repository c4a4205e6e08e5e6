"""Starts of the fit of a leaf patch: patches through the occupied voxels of the instance's hull."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import RAYS, STARTS
from mvseg.reconstruction.surface.leaf_patch import (
    COUNTS,
    CURL,
    FOLD,
    MIDRIB,
    NUM_COEFFICIENTS,
    SIDE,
    measure_patch,
    spline_basis,
)


def start_patches(points: Floats) -> list[Floats]:
    """Rough patches (26, 3), fold and curl 0, through centres of occupied voxels (P, 3) float64, the likely one first.

    The long axis is straight (PCA), or a geodesic one for elongated clouds, so that strongly bent blades keep their two
    ends. Windowed centroids along it are the midrib, spreads across it the sides. Cameras that all look down at one
    angle, or from one side, leave hulls of level leaves as thick as these are wide: there the spreads are no guide.

    The likely one runs along the longest axis; the others have sides in other directions, or run across it. None where
    all points are on one line, and none without a length.
    """
    points = _thin(points)
    if len(points) < 2:
        return []
    centred = points - points.mean(0)
    _, spreads, axes = np.linalg.svd(centred, full_matrices=False)
    if spreads[1] <= 1e-9 * spreads[0] or spreads[0] == 0:
        return []
    straight, along = centred @ axes[0], _geodesic_places(points)
    is_bent = spreads[0] > STARTS.elongated * spreads[1] or along.max() > STARTS.bent * np.ptp(straight)
    first = _patches_along(points, along if is_bent else straight, axes[1])
    starts = first + _patches_along(points, centred @ axes[1], axes[0])
    shortest = STARTS.thinnest * spreads[0] / np.sqrt(len(points))
    return [start for start in starts if measure_patch(start).length > shortest]


def _patches_along(points: Floats, place: Floats, side: Floats) -> list[Floats]:
    """Patches whose u follows `place` (P,); v of the first points along `side` (3,), of others about the midrib."""
    low, high = np.quantile(place, [STARTS.trimmed, 1 - STARTS.trimmed])
    t = np.clip((place - low) / max(high - low, 1e-12), 0, 1)
    middles, sides = _windows(points, t, side)
    return [_coefficients(middles, each) for each in sides]


def _thin(points: Floats) -> Floats:
    step = max(1, int(np.ceil(len(points) / STARTS.most_points)))
    return points[::step]


def _geodesic_places(points: Floats) -> Floats:
    """(P,) distance from a far end of the cloud, over the nearest-neighbour graph; loose pieces are joined."""
    tree = cKDTree(points)
    reach = tree.query(points, k=min(STARTS.neighbours + 1, len(points)))[0][:, -1]
    near = tree.query_ball_point(points, reach * (1 + RAYS.tie))  # of voxels that are equally near, all
    rows, columns = np.repeat(np.arange(len(points)), [len(each) for each in near]), np.concatenate(near).astype(int)
    distance = np.maximum(np.linalg.norm(points[rows] - points[columns], axis=1), 1e-12)
    graph = csr_matrix((distance, (rows, columns)), (len(points), len(points)))
    _, piece = connected_components(graph, directed=False)
    largest = np.flatnonzero(piece == np.bincount(piece).argmax())
    start = largest[_first_largest(np.linalg.norm(points[largest] - points[largest].mean(0), axis=1))]
    first = dijkstra(graph, directed=False, indices=start)
    end = largest[_first_largest(first[largest])]
    places = dijkstra(graph, directed=False, indices=end)
    loose = ~np.isfinite(places)
    if loose.any():
        places[loose] = places[largest[cKDTree(points[largest]).query(points[loose])[1]]]
    return places


def _first_largest(values: Floats) -> int:
    return int((values >= values.max() * (1 - RAYS.tie)).argmax())


def _windows(points: Floats, t: Floats, side: Floats) -> tuple[Floats, Floats]:
    """Centroids (9, 3) of overlapping windows along t in [0, 1], and half-width vectors (4, 9, 3) in all directions."""
    centres = (np.arange(STARTS.num_windows) + 0.5) / STARTS.num_windows
    weights = np.clip(1 - np.abs(t - centres[:, None]) * STARTS.num_windows, 0, None)
    for index in np.flatnonzero((weights > 0).sum(1) < STARTS.fewest):  # a gap in the cloud: the nearest points
        weights[index] = 0
        weights[index, np.argsort(np.abs(t - centres[index]), kind="stable")[: STARTS.nearest]] = 1
    middles = weights @ points / weights.sum(1, keepdims=True)
    along = np.gradient(middles, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    turns = np.radians(STARTS.turns_deg)[:, None]
    thinnest = STARTS.thinnest / 2 * float(np.linalg.norm(np.diff(middles, axis=0), axis=1).sum())
    directions, sides = np.zeros((STARTS.num_windows, 3)), np.zeros((len(turns), STARTS.num_windows, 3))
    for index in np.argsort(np.abs(centres - 0.5), kind="stable"):
        near = np.abs(t - centres[index]) < STARTS.window / STARTS.num_windows
        flat = points[near] - middles[index] if near.sum() >= STARTS.fewest else points - middles[index]
        flat = flat - (flat @ along[index])[:, None] * along[index]
        widest = np.linalg.eigh(flat.T @ flat)[1][:, 2]
        # Windows next to the middle one come first: each takes the sign of the nearest window that has a direction.
        done = np.flatnonzero(directions.any(1))
        before = directions[done[np.abs(done - index).argmin()]] if len(done) else side
        directions[index] = widest * (1.0 if widest @ before >= 0 else -1.0)
        turned = np.cos(turns) * directions[index] + np.sin(turns) * np.cross(along[index], directions[index])
        half_widths = np.maximum(np.quantile(np.abs(flat @ turned.T), STARTS.widest, axis=0), thinnest)
        sides[:, index] = half_widths[:, None] * turned
    return middles, sides


def _coefficients(middles: Floats, sides: Floats) -> Floats:
    """Splines through the windows; the ends of the midrib are pushed out by half a window to the ends of the cloud."""
    centres = (np.arange(STARTS.num_windows) + 0.5) / STARTS.num_windows
    first = middles[0] + 0.5 * (middles[0] - middles[1])
    last = middles[-1] + 0.5 * (middles[-1] - middles[-2])
    u = np.concatenate([[0.0], centres, [1.0]])
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB] = _smoother(u.tobytes(), COUNTS[0]) @ np.concatenate([first[None], middles, last[None]])
    f = np.sqrt(4 * centres * (1 - centres))[:, None]
    coefficients[SIDE] = _smoother(centres.tobytes(), COUNTS[1]) @ (sides / f)
    coefficients[FOLD], coefficients[CURL] = 0, 0
    return coefficients


@cache
def _smoother(places: bytes, count: int) -> Floats:
    """(count, P) from values at the places u (P,) to coefficients of a spline near them, with small second differences
    where the values leave freedom."""
    u = np.frombuffer(places)
    rows = np.concatenate([spline_basis(u, count), STARTS.smooth * np.diff(np.eye(count), 2, axis=0)])
    return np.linalg.pinv(rows)[:, : len(u)]
