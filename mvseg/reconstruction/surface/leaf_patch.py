"""A leaf as a spline patch: the surface, linear in its coefficients, and the prior of leaves.

    x(u, v) = m(u) + f(u) [v Q(u) + |v| R(u) + v^2 S(u)],    f(u) = sqrt(4 u (1 - u))

u in [0, 1] runs along the leaf, v in [-1, 1] across it. m is the midrib, Q points to the side, R folds the two halves
about the midrib (and tells them apart), S curls them. m, Q, R and S are clamped B-splines with vector coefficients, 26
in all; f closes the outline at both ends. Coefficients are (26, 3) float64 arrays in the order m, Q, R, S.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import BSpline

from mvseg.arrays import Floats, Ints
from mvseg.reconstruction.numbers import FIT, PRIOR

COUNTS = (7, 12, 4, 3)  # definition: m, Q, R, S have so many coefficients; fewer for Q cannot follow lobes
NUM_COEFFICIENTS = sum(COUNTS)
MIDRIB, SIDE, FOLD, CURL = (slice(sum(COUNTS[:part]), sum(COUNTS[: part + 1])) for part in range(len(COUNTS)))


def spline_basis(u: Floats, count: int) -> Floats:
    """(P, count) values of the clamped B-splines on [0, 1], cubic, or of degree count - 1 where that is less."""
    degree = min(3, count - 1)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, count - degree + 1), np.ones(degree)])
    return BSpline.design_matrix(np.clip(u, 0, 1), knots, degree).toarray()


def patch_basis(u: Floats, v: Floats) -> Floats:
    """(P, 26) matrix B of the points (u, v), both (P,): their positions are `B @ coefficients`."""
    f = np.sqrt(np.clip(4 * u * (1 - u), 0, None))
    factors = (np.ones_like(u), f * v, f * np.abs(v), f * v**2)
    return np.concatenate(
        [factor[:, None] * spline_basis(u, count) for factor, count in zip(factors, COUNTS, strict=True)], 1
    )


@dataclass(frozen=True, eq=False)
class PatchGrid:
    """A grid of (rows, columns) points on the patch.

    Attributes:
        u: (rows,) places along the leaf, 0 and 1 included. There f is 0: the ends of the grid are single points.
        v: (columns,) places across, -1 to 1, an odd number, so that the midrib is a grid line.
        basis: (rows * columns, 26).
    """

    u: Floats
    v: Floats
    basis: Floats

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.u), len(self.v)

    @cached_property
    def outline_basis(self) -> Floats:
        """(3 * rows * columns, 26) where samples of an outline may lie: the points of the grid, row by row; the middles
        between each of them and the next one of its column; and those between it and the next one of its row. After the
        last one of a column or row there is none: these rows mean nothing."""
        grid = self.basis.reshape(*self.shape, -1)
        middles = [(grid + np.roll(grid, -1, axis)) / 2 for axis in (0, 1)]
        return np.concatenate([grid, *middles]).reshape(-1, NUM_COEFFICIENTS)

    def points(self, coefficients: Floats) -> Floats:
        """(..., rows, columns, 3) positions, of coefficients (..., 26, 3)."""
        return (self.basis @ coefficients).reshape(*coefficients.shape[:-2], *self.shape, 3)


@cache
def patch_grid(num_rows: int, num_columns: int) -> PatchGrid:
    """The grid that many functions share; treat its arrays as constants."""
    t, v = np.linspace(0, 1, num_rows), np.linspace(-1, 1, num_columns)
    u = FIT.even * t + (1 - FIT.even) / 2 * (1 - np.cos(np.pi * t))  # denser at both ends, where the outline is round
    rows, columns = np.meshgrid(u, v, indexing="ij")
    return PatchGrid(u=u, v=v, basis=patch_basis(rows.ravel(), columns.ravel()))


def grid_triangles(num_rows: int, num_columns: int) -> Ints:
    """(F, 3) triangles of a patch grid whose first and last row are one vertex each. Vertex 0 is the base, vertex 1 +
    (row - 1) * num_columns + column an inner point, the last vertex the tip."""
    inner = 1 + np.arange((num_rows - 2) * num_columns).reshape(num_rows - 2, num_columns)
    base, tip = np.zeros(num_columns - 1, int), np.full(num_columns - 1, inner[-1, -1] + 1)
    return np.concatenate([
        np.stack([base, inner[0, :-1], inner[0, 1:]], 1),
        grid_faces(inner),
        np.stack([tip, inner[-1, 1:], inner[-1, :-1]], 1),
    ])  # fmt: skip


def grid_faces(grid: Ints) -> Ints:
    """(F, 3) two triangles for each cell of an (r, c) grid of vertex indices; normals point at a viewer who sees the
    rows run down and the columns run to the right."""
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    return np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])


def grid_vertices(points: Floats) -> Floats:
    """(P, n) vertices of `grid_triangles` from (rows, columns, n) grid points, n = 3 in space and 2 in pixels."""
    return np.concatenate([points[0, :1], points[1:-1].reshape(-1, points.shape[-1]), points[-1, :1]])


@dataclass(frozen=True, eq=False)
class PatchSize:
    """Units of the prior and of the fit's steps: midrib length and largest half-width, of one patch or several
    (...)."""

    length: Floats
    half_width: Floats


def measure_patch(coefficients: Floats) -> PatchSize:
    """Length and largest half-width of a patch, or of several (..., 26, 3), world units."""
    points = patch_grid(*FIT.grid).points(coefficients)
    length = np.linalg.norm(np.diff(points[..., FIT.grid[1] // 2, :], axis=-2), axis=-1).sum(-1)
    width = np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(-1).max(-1)
    return PatchSize(length=length, half_width=width / 2)


def patch_prior(coefficients: Floats, size: PatchSize, *, noise: Floats | float) -> tuple[Floats, Floats]:
    """Prior of leaves, as linear equations about the present coefficients (..., 26, 3).

    Directions (along the midrib, normal) are those of the present patch, so that turns of the world do not matter.

    Args:
        size: (...) length and half-width that the standard deviations are relative to.
        noise: (...) >= 1; fold, curl and shear, which faulty masks say little about, are held nearer to none by it.

    Returns:
        A (..., E, 78) and b (..., E): A @ coefficients.ravel() should be b with standard deviation 1.
    """
    length, half, noise = (np.asarray(each)[..., None, None] for each in (size.length, size.half_width, noise))
    bend, side, fold = _difference_rows()
    *frames, pieces = _frames(coefficients)
    tangents = unit_vectors(_speed_rows() @ coefficients)
    equations = [bend / (PRIOR.bend_sd * length), side / (PRIOR.side_sd * half)]
    equations += [fold * (noise / (PRIOR.fold_step_sd * half))]
    shear, upright = noise / (PRIOR.shear_sd * half), noise / (PRIOR.normal_sd * half)
    directions = [frames[0][0] * shear]
    for along, across, normal in frames[1:]:
        directions += [along * shear, across * shear, normal * upright]
    # The outline of a round blade does not tell where its midrib runs, which would wind and come out too long. That of
    # a narrow one does.
    directions += [pieces[1][..., 1:-1, :] * (2 * half / (PRIOR.sway_sd * length**2))]
    directions += [tangents / (PRIOR.speed_sd * length)]
    directed = _directed_rows()[:, :, None] * np.concatenate(directions, -2)[..., None, :]
    equations.append(directed.reshape(*directed.shape[:-2], -1))
    asked = np.concatenate(equations, -2)
    target = np.zeros(asked.shape[:-1])
    target[..., -tangents.shape[-2] :] = 1 / PRIOR.speed_sd
    return asked, target


@cache
def _directed_rows() -> Floats:
    """(E, 26) rows held along directions: Q, R and S, turns of the midrib, and its speed."""
    side, fold, curl = (np.eye(NUM_COEFFICIENTS)[part] for part in (SIDE, FOLD, CURL))
    return np.concatenate([side, *[fold] * 3, *[curl] * 3, np.diff(_speed_rows(), axis=0), _speed_rows()])


@cache
def _difference_rows() -> tuple[Floats, Floats, Floats]:
    """(E, 78) third differences of m, second ones of Q and first ones of R, along all three axes."""
    return _differences(MIDRIB, 3), _differences(SIDE, 2), _differences(FOLD, 1)


def _differences(part: slice, order: int) -> Floats:
    return np.asarray(np.kron(np.diff(np.eye(NUM_COEFFICIENTS)[part], order, axis=0), np.eye(3)), dtype=float)


@cache
def _speed_rows() -> Floats:
    """(10, 26) rows that give dm/du on ten pieces of the midrib."""
    u = np.linspace(0, 1, PRIOR.num_pieces + 1)
    return np.diff(patch_basis(u, np.zeros_like(u)), axis=0) * PRIOR.num_pieces


def _frame_counts() -> tuple[int, ...]:
    """Numbers of evenly spaced directions that the prior needs: for Q, R, S, and for the ends of pieces."""
    return *COUNTS[1:], PRIOR.num_pieces + 1


def _frames(coefficients: Floats) -> list[tuple[Floats, Floats, Floats]]:
    """Directions along, across and normal to the blade, (..., count, 3) each, at the places of `_frame_counts`."""
    ahead, sideways = _frame_rows()
    along = unit_vectors(ahead @ coefficients)
    side = sideways @ coefficients[..., SIDE, :]
    # Where the side vector vanishes (pointed ends) the mean one stands in.
    side = side + PRIOR.pointed * coefficients[..., SIDE, :].mean(-2, keepdims=True)
    across = unit_vectors(side - (side * along).sum(-1, keepdims=True) * along)
    ends = np.cumsum(_frame_counts())[:-1]
    return list(zip(*(np.split(each, ends, -2) for each in (along, across, cross(along, across))), strict=True))


@cache
def _frame_rows() -> tuple[Floats, Floats]:
    """(sum of `_frame_counts`, 26) rows of directions along the midrib, and (same, 12) of the side vectors."""
    places = np.concatenate([np.linspace(0, 1, count) for count in _frame_counts()])
    middle = np.clip(places, PRIOR.step, 1 - PRIOR.step)
    zeros = np.zeros_like(middle)
    ahead = patch_basis(middle + PRIOR.step, zeros) - patch_basis(middle - PRIOR.step, zeros)
    return ahead, spline_basis(middle, COUNTS[1])


def cross(first: Floats, second: Floats) -> Floats:
    """(..., 3) cross products; `np.cross` is slow on few."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def unit_vectors(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
