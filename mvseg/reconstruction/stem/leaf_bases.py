"""Bases of leaves, and the axis that their petioles, seen from the blades, point back to.

A petiole leaves the blade against the direction in which its midrib begins. Where no mask shows the stem, its axis is
the curve near which most of these rays pass. The base of a leaf is the end nearer to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import AXES
from mvseg.reconstruction.stem.stem_axis import StemAxis
from mvseg.reconstruction.surface.leaf_patch import patch_basis
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.table import Table


@dataclass(frozen=True, eq=False)
class LeafBases(Table):
    """Bases of N leaves.

    Attributes:
        ids: (N,) int64 of the instances.
        points: (N, 3) where the midrib begins.
        ahead: (N, 3) unit vectors along the midrib there.
        near: (N, 3) points of the midrib at `AXES.lever` of its length.
        lengths: (N,) of the leaves.
        point_sd: (N,) standard deviation of the points, along any axis.
        angle_sd: (N,) standard deviation of the directions, radians.
    """

    ids: NDArray[np.int64]
    points: Floats
    ahead: Floats
    near: Floats
    lengths: Floats
    point_sd: Floats
    angle_sd: Floats


def find_ends(surfaces: Mapping[int, LeafSurface]) -> tuple[LeafBases, LeafBases]:
    """Both ends of each surface that exists, as if they were the bases: those at u = 0, and those at u = 1."""
    there = {instance: surface for instance, surface in sorted(surfaces.items()) if surface.exists}
    return _ends(there, is_reversed=False), _ends(there, is_reversed=True)


def _ends(surfaces: Mapping[int, LeafSurface], *, is_reversed: bool) -> LeafBases:
    u = np.array([0.0, AXES.begins, AXES.lever])
    rows = patch_basis(1 - u if is_reversed else u, np.zeros(3))
    places = [rows @ surface.coefficients.numpy() for surface in surfaces.values()]
    first, second, third = np.array(places).reshape(-1, 3, 3).transpose(1, 0, 2)
    step = np.linalg.norm(second - first, axis=1)
    spreads = []
    for surface, size in zip(surfaces.values(), step, strict=True):
        covariance = surface.covariance.numpy().reshape(len(rows[0]), 3, len(rows[0]), 3)
        both = np.einsum("pi,iajb,qj->paqb", rows[:2], covariance, rows[:2])
        point = np.sqrt(max(np.trace(both[0, :, 0]) / 3, 0))
        moved = both[0, :, 0] + both[1, :, 1] - both[0, :, 1] - both[1, :, 0]
        spreads.append((point, np.sqrt(max(np.trace(moved) / 3, 0)) / max(size, 1e-300)))
    point_sd, angle_sd = np.array(spreads).reshape(-1, 2).T
    return LeafBases(
        ids=np.array(list(surfaces), np.int64),
        points=first,
        ahead=(second - first) / np.maximum(step, 1e-300)[:, None],
        near=third,
        lengths=np.array([surface.length for surface in surfaces.values()]),
        point_sd=point_sd,
        angle_sd=angle_sd,
    )


@dataclass(frozen=True, eq=False)
class BaseAxis:
    """An axis from the lowest node up to the highest one, and the bases of the leaves whose rays pass near it."""

    axis: StemAxis
    bases: LeafBases


def axes_of_bases(surfaces: Mapping[int, LeafSurface], up: Floats | None) -> tuple[BaseAxis, ...]:
    """Find the axes that the leaves of a plant point back to, one for each stem, that of the most leaves first; ()
    where fewer than `AXES.near_share` of the leaves point to any, as in a rosette.

    Args:
        surfaces: {instance id: surface} of leaves.
        up: (3,) unit vector; None: not known. Then the side to which most leaves rise is above.
    """
    first, second = find_ends(surfaces)
    is_free, axes = np.ones(len(first), bool), []
    while is_free.sum() >= (AXES.least_leaves if is_free.all() else AXES.least_of_many):
        axis = _find_axis(first.select(is_free), second.select(is_free), up)
        if axis is None:
            break
        axes.append(axis)
        is_free &= ~np.isin(first.ids, axis.bases.ids)
    return tuple(axes) if len(first) and 1 - is_free.mean() >= AXES.near_share else ()


def _find_axis(first: LeafBases, second: LeafBases, up: Floats | None) -> BaseAxis | None:
    """The axis of the most leaves; None where they are few, or nodes hardly farther apart than petioles are long."""
    size = float(np.median(first.lengths))
    starts = _start_lines(first, second, up, size=size)
    fits = [_fit_axis(first, second, start, size=size) for start in starts]
    costs = [
        _cost(bases, nodes, distances, size) + _lean_cost(points[-1] - points[0], up, len(bases))
        for points, bases, nodes, distances, _ in fits
    ]
    points, bases, nodes, distances, along = fits[int(np.argmin(costs))]
    is_near = distances < AXES.near * size
    if is_near.sum() < (AXES.least_leaves if is_near.mean() >= AXES.near_share else AXES.least_of_many):
        return None
    petioles = np.linalg.norm(bases.points - nodes, axis=1)
    width = max(*(float(np.median(each[is_near])) for each in (distances, petioles)), AXES.least_miss * size)
    if float(np.ptp(along[is_near])) < AXES.least_extent * width:
        return None
    rising = bases.ahead[is_near].sum(0) if up is None else up
    axis = StemAxis.along(points if (points[-1] - points[0]) @ rising >= 0 else points[::-1])
    return BaseAxis(axis, bases.select(is_near))


def _start_lines(first: LeafBases, second: LeafBases, up: Floats | None, *, size: float) -> list[tuple[Floats, Floats]]:
    """Points and directions of lines near which an axis may lie: of many lines, those that most rays pass."""
    bases = first.points
    middle, meeting = np.median(bases, axis=0), _nearest_to_rays(bases, first.ahead)
    along = np.linalg.svd(bases - middle)[2][0]
    lines = [(middle, along), (meeting, along)]
    if up is not None:
        lines += [(middle, up), (meeting, up)]
    either = np.concatenate([first.points, second.points])
    one, other = np.triu_indices(len(either), 1)
    length = np.linalg.norm(either[other] - either[one], axis=1)
    pairs = np.flatnonzero((length > AXES.near * size) & (one % len(bases) != other % len(bases)))
    pairs = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), AXES.most_pairs)).astype(int)]
    lines += [(either[one[pair]], either[other[pair]] - either[one[pair]]) for pair in pairs]
    costs = []
    for point, direction in lines:
        ahead = direction / np.linalg.norm(direction)
        either_end = np.minimum(*(_line_costs(ends, point, ahead, size) for ends in (first, second)))
        costs.append(float(either_end.sum()) + _lean_cost(ahead, up, len(bases)))
    best = np.argsort(costs, kind="stable")[: AXES.most_starts]
    return [lines[index] for index in best.tolist()]


def _line_costs(bases: LeafBases, point: Floats, ahead: Floats, size: float) -> Floats:
    """(N,) the `_cost` of a line for each leaf, of rays that are no longer than petioles are."""
    away = bases.points - point
    away = away - (away @ ahead)[:, None] * ahead
    back = -bases.ahead + (bases.ahead @ ahead)[:, None] * ahead
    t = -(away * back).sum(1) / np.maximum((back**2).sum(1), 1e-12)
    t = np.clip(t, 0, AXES.longest_petiole * bases.lengths)
    squares = ((away + t[:, None] * back) ** 2).sum(1) / (AXES.near * size) ** 2
    return np.asarray(squares / (1 + squares) + AXES.petiole_square * (t / bases.lengths) ** 2)


def _nearest_to_rays(points: Floats, ahead: Floats) -> Floats:
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None]
    origin = points.mean(0)
    target = np.einsum("nij,nj->i", across, points - origin)
    return np.asarray(origin + np.linalg.pinv(across.sum(0), rcond=1e-9) @ target)


def _cost(bases: LeafBases, nodes: Floats, distances: Floats, size: float) -> float:
    """Cost of an axis: robust distances (N,) of rays, and lengths of petioles from nodes (N, 3)."""
    squares = (distances / (AXES.near * size)) ** 2
    petioles = np.linalg.norm(bases.points - nodes, axis=1) / bases.lengths
    return float((squares / (1 + squares) + AXES.petiole_square * petioles**2).sum())


def _lean_cost(ahead: Floats, up: Floats | None, num_leaves: int) -> float:
    """Cost of an axis that leans along a direction (3,): leaves of two stems also point to lines across both."""
    if up is None:
        return 0.0
    cosine = float(ahead @ up) / max(float(np.linalg.norm(ahead)), 1e-300)
    return AXES.lean_cost * num_leaves * (1 - cosine**2)


def _fit_axis(
    first: LeafBases, second: LeafBases, line: tuple[Floats, Floats], *, size: float
) -> tuple[Floats, LeafBases, Floats, Floats, Floats]:
    """Choose ends and refit in turn: curve (P, 3), bases, nodes (N, 3), rays' distances (N,), places (N,)."""
    middle, direction = line
    direction = direction / np.linalg.norm(direction)
    reach = max(float(np.ptp((first.points - middle) @ direction)), size)
    curve = middle + np.linspace(-reach, reach, AXES.points)[:, None] * direction
    for turn in range(AXES.rounds):
        bases = choose_ends(first, second, curve)
        nodes, distances, along = project_bases(bases, curve)
        weight = 1 / (1 + (distances / (AXES.near * size)) ** 2)
        degree = 1 if turn < AXES.rounds // 2 or len(bases) < AXES.bent_leaves else 2
        chord = curve[-1] - curve[0]
        chord = chord / np.linalg.norm(chord)
        place = (nodes - curve[0]) @ chord
        scale = max(float(np.ptp(place)), 1e-3 * size)
        t = (place - place.mean()) / scale
        rows = np.stack([t**power for power in range(degree + 1)], 1)
        # A bend, and a tilt of few leaves, must be worth it.
        prior = np.diag([0.0, AXES.tilt_cost, AXES.bend_cost][: degree + 1])
        petiole = np.linalg.norm(bases.points - nodes, axis=1) / bases.lengths
        is_free = (petiole > AXES.least_petiole) & (petiole < AXES.longest_petiole - AXES.least_petiole)
        back = _look_back(bases, curve)
        # The axis may be anywhere along a ray, but not beside it. Leaves in two rows point to any line between these:
        # the middle of their bases is the likely one.
        along_ray = back[:, :, None] * back[:, None] * np.where(is_free, 1 - AXES.to_bases, 0)[:, None, None]
        across = weight[:, None, None] * (np.eye(3) - along_ray)
        targets = np.where(is_free[:, None], bases.points, nodes) - (curve[0] + place[:, None] * chord)
        system = np.einsum("np,nij,nq->piqj", rows, across, rows).reshape(3 * degree + 3, -1)
        right = np.einsum("np,nij,nj->pi", rows, across, targets).ravel()
        offset = np.linalg.solve(system + np.kron(prior, np.eye(3)), right).reshape(degree + 1, 3)
        even = np.linspace(float(t.min()) - AXES.beyond, float(t.max()) + AXES.beyond, AXES.points)
        curve = curve[0] + (even * scale + place.mean())[:, None] * chord
        curve = curve + np.stack([even**power for power in range(degree + 1)], 1) @ offset
    bases = choose_ends(first, second, curve)
    nodes, distances, along = project_bases(bases, curve)
    near = distances < AXES.near * size
    if near.sum() >= 2:  # from the lowest node to the highest one
        places = np.append(0, np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum())
        keep = np.linspace(along[near].min(), along[near].max(), AXES.points)
        curve = np.stack([np.interp(keep, places, axis) for axis in curve.T], 1)
    return curve, bases, nodes, distances, along


def choose_ends(first: LeafBases, second: LeafBases, curve: Floats) -> LeafBases:
    """Choose the end of each leaf that is nearer to a curve (P, 3)."""
    gaps = [np.linalg.norm(each.points[:, None] - curve, axis=2).min(1) for each in (first, second)]
    return LeafBases.concatenate((first, second)).select(np.arange(len(first)) + len(first) * (gaps[1] < gaps[0]))


def project_bases(bases: LeafBases, curve: Floats) -> tuple[Floats, Floats, Floats]:
    """Project bases along their rays back to a curve (P, 3), which leads upwards.

    A ray goes back from the base by at most `AXES.longest_petiole` of the leaf's length. Petioles bend down under their
    blades: they come from somewhat lower than the midrib points back to.

    Returns:
        (N, 3) the points of the rays that are nearest to the curve, where length costs a little, (N,) their distances,
        and (N,) how far along the curve they are.
    """
    back = _look_back(bases, curve)
    step = AXES.longest_petiole / (AXES.ray_steps - 1)
    t = np.tile(step * np.arange(AXES.ray_steps), (len(bases), 1))
    rough, _, _ = _nearest_on_rays(bases, back, curve, t)
    fine = rough[:, None] + step * np.linspace(-1, 1, AXES.ray_steps)
    t, gap, along = _nearest_on_rays(bases, back, curve, np.clip(fine, 0, AXES.longest_petiole))
    return bases.points + (t * bases.lengths)[:, None] * back, gap, along


def _look_back(bases: LeafBases, curve: Floats) -> Floats:
    """(N, 3) unit vectors of rays from bases back to where petioles come from, of a curve (P, 3) that leads upwards."""
    upwards = curve[-1] - curve[0]
    upwards = upwards / max(float(np.linalg.norm(upwards)), 1e-300)
    back = -bases.ahead
    level = upwards - (back @ upwards)[:, None] * back
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-12)
    turn = np.radians(AXES.arch_deg)
    return np.asarray(np.cos(turn) * back - np.sin(turn) * level)


def _nearest_on_rays(bases: LeafBases, back: Floats, curve: Floats, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Places (N,) on rays, among t (N, R) in leaf lengths; distances (N,) and places (N,) on the curve (P, 3)."""
    rays = bases.points[:, None] + (t * bases.lengths[:, None])[..., None] * back[:, None]
    starts, steps = curve[:-1], np.diff(curve, axis=0)
    size = np.maximum((steps**2).sum(1), 1e-300)
    away = rays[:, :, None] - starts
    share = np.clip((away * steps).sum(3) / size, 0, 1)
    gaps = np.linalg.norm(away - share[..., None] * steps, axis=3)
    piece = gaps.argmin(2)
    gap = np.take_along_axis(gaps, piece[..., None], 2)[..., 0]
    best = (gap + AXES.petiole_cost * t * bases.lengths[:, None]).argmin(1)
    rows = np.arange(len(bases))
    piece = piece[rows, best]
    reach = np.append(0, np.sqrt(size).cumsum())
    along = reach[piece] + share[rows, best, piece] * np.sqrt(size[piece])
    return t[rows, best], gap[rows, best], along
