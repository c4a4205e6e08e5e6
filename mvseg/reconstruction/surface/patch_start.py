"""Where the fit of a leaf patch starts: a patch through the occupied voxels of the instance's hull."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from mvseg.reconstruction.surface.leaf_patch import (
    COUNTS,
    CURL,
    FOLD,
    MIDRIB,
    NUM_COEFFICIENTS,
    SIDE,
    Floats,
    measure_patch,
    spline_basis,
)

MOST_POINTS = 1000  # so many voxels are used at most, which is enough for nine windows (a technical limit)
NUM_WINDOWS = 9  # the midrib of a start goes through the middles of so many windows along the leaf
NEIGHBOURS = 8  # a voxel is joined to so many others where the way along a leaf is looked for
# A leaf may be so bent that its axis is a curve if the ratio of its two largest deviations is at least this.
ELONGATED = 2.0
BENT = 1.35  # or if the way along it is so many times the straight one: graphs make detours of a tenth
TURNS_DEG = (0.0, 90.0, 45.0, 135.0)  # starts have their side at these angles about the midrib
# A start is at least so wide, as a share of its length, and so long, as a share of the cloud's deviation: masks of a
# pixel have flat hulls, or hulls of a few voxels.
THINNEST = 0.01
TIE = 1e-6  # distances on a lattice are equal if they differ by less than this share, by rounding


def start_patches(points: Floats) -> list[Floats]:
    """Rough patches through a cloud of points, the likely one first.

    The long axis is straight (PCA), or a geodesic one for elongated clouds, so that strongly bent blades keep their
    two ends. Windowed centroids along it are the midrib, spreads across it the sides. Cameras that all look down at
    one angle, or from one side, leave hulls of level leaves as thick as these are wide: there the spreads are no guide.

    Args:
        points: (P, 3) float64, centres of occupied voxels.

    Returns:
        (26, 3) coefficients each, fold and curl 0. The likely one runs along the longest axis; the others have sides in
        other directions, or run across it. None where all points are on one line, and none without a length.
    """
    points = _thin(points)
    if len(points) < 2:
        return []
    centred = points - points.mean(0)
    _, spreads, axes = np.linalg.svd(centred, full_matrices=False)
    if spreads[1] <= 1e-9 * spreads[0] or spreads[0] == 0:
        return []
    straight, along = centred @ axes[0], _geodesic_places(points)
    is_bent = spreads[0] > ELONGATED * spreads[1] or along.max() > BENT * np.ptp(straight)
    first = _patches_along(points, along if is_bent else straight, axes[1])
    starts = first + _patches_along(points, centred @ axes[1], axes[0])
    shortest = THINNEST * spreads[0] / np.sqrt(len(points))
    return [start for start in starts if measure_patch(start).length > shortest]


def _patches_along(points: Floats, place: Floats, side: Floats) -> list[Floats]:
    """Patches whose u follows `place` (P,).

    `side` (3,) is roughly where v of the first points to: along the largest spread across; the others are turned about
    the midrib.
    """
    low, high = np.quantile(place, [0.005, 0.995])
    t = np.clip((place - low) / max(high - low, 1e-12), 0, 1)
    middles, sides = _windows(points, t, side)
    return [_coefficients(middles, each) for each in sides]


def _thin(points: Floats) -> Floats:
    """Every so many points, in their order: deterministic, and even for the lattice order of voxels."""
    step = max(1, int(np.ceil(len(points) / MOST_POINTS)))
    return points[::step]


def _geodesic_places(points: Floats) -> Floats:
    """(P,) distance along the cloud from one of its far ends, over the nearest-neighbour graph.

    Loose pieces are joined by the straight distance to the nearest point of the largest piece.
    """
    tree = cKDTree(points)
    reach = tree.query(points, k=min(NEIGHBOURS + 1, len(points)))[0][:, -1]
    near = tree.query_ball_point(points, reach * (1 + TIE))  # of voxels that are equally near, all
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
    """Place of the first of the largest values (P,), of those that tie."""
    return int((values >= values.max() * (1 - TIE)).argmax())


def _windows(points: Floats, t: Floats, side: Floats) -> tuple[Floats, Floats]:
    """Centroids (9, 3) of overlapping windows along t in [0, 1], and half-width vectors (4, 9, 3) in all directions."""
    centres = (np.arange(NUM_WINDOWS) + 0.5) / NUM_WINDOWS
    weights = np.clip(1 - np.abs(t - centres[:, None]) * NUM_WINDOWS, 0, None)
    for index in np.flatnonzero((weights > 0).sum(1) < 4):  # a gap in the cloud: the nearest points
        weights[index] = 0
        weights[index, np.argsort(np.abs(t - centres[index]), kind="stable")[:8]] = 1
    middles = weights @ points / weights.sum(1, keepdims=True)
    along = np.gradient(middles, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    turns = np.radians(TURNS_DEG)[:, None]
    thinnest = THINNEST / 2 * float(np.linalg.norm(np.diff(middles, axis=0), axis=1).sum())
    directions, sides = np.zeros((NUM_WINDOWS, 3)), np.zeros((len(turns), NUM_WINDOWS, 3))
    for index in np.argsort(np.abs(centres - 0.5), kind="stable"):
        near = np.abs(t - centres[index]) < 0.75 / NUM_WINDOWS
        flat = points[near] - middles[index] if near.sum() >= 4 else points - middles[index]
        flat = flat - (flat @ along[index])[:, None] * along[index]
        widest = np.linalg.eigh(flat.T @ flat)[1][:, 2]
        # Windows next to the middle one come first: each takes the sign of the nearest window that has a direction.
        done = np.flatnonzero(directions.any(1))
        before = directions[done[np.abs(done - index).argmin()]] if len(done) else side
        directions[index] = widest * (1.0 if widest @ before >= 0 else -1.0)
        turned = np.cos(turns) * directions[index] + np.sin(turns) * np.cross(along[index], directions[index])
        half_widths = np.maximum(np.quantile(np.abs(flat @ turned.T), 0.93, axis=0), thinnest)
        sides[:, index] = half_widths[:, None] * turned
    return middles, sides


def _coefficients(middles: Floats, sides: Floats) -> Floats:
    """Splines through the windows; the ends of the midrib are pushed out by half a window to the ends of the cloud."""
    centres = (np.arange(NUM_WINDOWS) + 0.5) / NUM_WINDOWS
    first = middles[0] + 0.5 * (middles[0] - middles[1])
    last = middles[-1] + 0.5 * (middles[-1] - middles[-2])
    u = np.concatenate([[0.0], centres, [1.0]])
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB] = _smooth_fit(u, np.concatenate([first[None], middles, last[None]]), COUNTS[0])
    f = np.sqrt(4 * centres * (1 - centres))[:, None]
    coefficients[SIDE] = _smooth_fit(centres, sides / f, COUNTS[1])
    coefficients[FOLD], coefficients[CURL] = 0, 0
    return coefficients


def _smooth_fit(u: Floats, values: Floats, count: int) -> Floats:
    """(count, 3) spline coefficients near the values, with small second differences where the values leave freedom."""
    return _smoother(u.tobytes(), count) @ values


@cache
def _smoother(places: bytes, count: int) -> Floats:
    """(count, P) from values at the places u (P,) to the coefficients of `_smooth_fit`."""
    u = np.frombuffer(places)
    rows = np.concatenate([spline_basis(u, count), 0.3 * np.diff(np.eye(count), 2, axis=0)])
    return np.linalg.pinv(rows)[:, : len(u)]
