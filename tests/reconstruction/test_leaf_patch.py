from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from mvseg.reconstruction.surface.leaf_patch import (
    COUNTS,
    MIDRIB,
    NUM_COEFFICIENTS,
    SIDE,
    Floats,
    PatchSize,
    grid_triangles,
    grid_vertices,
    measure_patch,
    patch_basis,
    patch_grid,
    patch_prior,
)
from mvseg.reconstruction.surface.orientation import base_distances, mirror_matrix, reversal_matrix, stem_distances
from mvseg.reconstruction.surface.patch_start import start_patches


def wavy_patch(seed: int = 0) -> Floats:
    coefficients = np.random.default_rng(seed).normal(0, 0.05, (NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB, 0] += np.linspace(0, 4, COUNTS[0])
    coefficients[SIDE, 1] += 1
    return coefficients


def evaluate_reference(coefficients: Floats, u: float, v: float) -> Floats:
    """x(u, v) as the formula reads, a spline at a time."""
    values = []
    for part, count in zip(np.split(coefficients, np.cumsum(COUNTS)[:-1]), COUNTS, strict=True):
        degree = min(3, count - 1)
        knots = [*[0.0] * degree, *np.linspace(0, 1, count - degree + 1), *[1.0] * degree]
        values.append(BSpline(knots, part, degree)(u))
    m, q, r, s = values
    return m + np.sqrt(4 * u * (1 - u)) * (v * q + abs(v) * r + v * v * s)


def test_basis_is_the_formula() -> None:
    coefficients = wavy_patch()
    for u, v in ((0.0, 0.5), (0.2, -1.0), (0.37, 0.25), (0.5, 0.0), (1.0, 1.0)):
        point = patch_basis(np.array([u]), np.array([v])) @ coefficients
        assert point[0] == pytest.approx(evaluate_reference(coefficients, u, v), abs=1e-12)


def test_mesh_is_one_open_disc() -> None:
    mesh = trimesh.Trimesh(grid_vertices(patch_grid(12, 5).points(wavy_patch())), grid_triangles(12, 5), process=False)
    assert mesh.euler_number == 1
    assert mesh.is_winding_consistent
    _, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    assert counts.max() == 2
    assert (counts == 1).sum() == 2 * (12 - 1)  # the rim
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB, 0] = np.linspace(0, 1, COUNTS[0])
    coefficients[SIDE, 1] = 0.25
    size = measure_patch(coefficients)
    assert size.length == pytest.approx(1)
    assert size.half_width == pytest.approx(0.25, rel=2e-3)


def test_prior_asks_nothing_of_an_even_flat_patch() -> None:
    """Equal spacing of the Greville points makes an even midrib; sides across it are without shear."""
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB, 0] = [0, 1 / 12, 1 / 4, 1 / 2, 3 / 4, 11 / 12, 1]
    coefficients[SIDE, 1] = 0.3
    equations, target = patch_prior(coefficients, PatchSize(length=1.0, half_width=0.3), noise=1.0)
    surprise = equations @ coefficients.ravel() - target
    bend = np.zeros(len(surprise), bool)
    bend[:12] = True  # third differences of coefficients at clamped ends are not those of the curve
    assert np.abs(surprise[~bend]).max() < 1e-9
    assert np.abs(surprise[bend]).max() < 1.5


def test_turned_and_mirrored_patches_are_the_same_surface() -> None:
    coefficients, grid = wavy_patch(), patch_grid(12, 5)
    points = grid.points(coefficients)
    assert grid.points(reversal_matrix() @ coefficients) == pytest.approx(points[::-1, ::-1], abs=1e-12)
    assert grid.points(mirror_matrix() @ coefficients) == pytest.approx(points[:, ::-1], abs=1e-12)


def test_stem_is_where_the_bases_line_up() -> None:
    rng = np.random.default_rng(0)
    heights, azimuths = np.linspace(0, 100, 9), rng.uniform(0, 2 * np.pi, 9)
    stem = np.stack([np.zeros(9), np.zeros(9), heights], 1)
    out = np.stack([np.cos(azimuths), np.sin(azimuths), rng.uniform(-0.5, 0.5, 9)], 1)
    ends = np.stack([stem + 10 * out, stem + 70 * out], 1)
    swapped = rng.random(9) < 0.5
    ends[swapped] = ends[swapped, ::-1]
    assert (stem_distances(ends).argmin(1) == swapped).all()


@pytest.mark.parametrize("num_leaves", [2, 3])
def test_the_bases_of_a_seedling_are_the_ends_that_are_nearest_to_each_other(num_leaves: int) -> None:
    rng = np.random.default_rng(num_leaves)
    for _ in range(20):
        stem = rng.normal(0, 0.08, (num_leaves, 3))
        turns = 2 * np.pi * (np.arange(num_leaves) / num_leaves + rng.uniform(-0.1, 0.1, num_leaves))
        ahead = np.stack([np.cos(turns), np.sin(turns), rng.uniform(-0.3, 0.8, num_leaves)], 1)
        ends = np.stack([stem, stem + ahead], 1)
        swapped = rng.integers(0, 2, num_leaves)
        ends[swapped == 1] = ends[swapped == 1][:, ::-1]
        distances = base_distances(ends)
        assert (distances.argmin(1) == swapped).all()
        order, turn = rng.permutation(num_leaves), Rotation.random(random_state=1).as_matrix()
        np.testing.assert_allclose(base_distances(7 * ends[order] @ turn.T + 5), 7 * distances[order])


def test_a_single_leaf_and_leaves_side_by_side_stay_as_they_are() -> None:
    assert base_distances(np.zeros((0, 2, 3))).shape == (0, 2)
    one = np.array([[[0.0, 0, 0], [1, 0, 0]]])
    assert base_distances(one).tolist() == [[0, 0]]
    beside = np.concatenate([one, one + (0, 1, 0)])
    distances = base_distances(beside)
    assert (distances[:, 0] < distances[:, 1]).all()  # of two choices that are equal, the ends that come first


@pytest.mark.parametrize("bend", [1e3, 0.45])
def test_start_follows_a_strip_from_end_to_end(bend: float) -> None:
    s, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-0.1, 0.1, 9)))
    cloud = np.stack([bend * np.sin(s / bend), y, bend * (np.cos(s / bend) - 1)], 1)
    size = measure_patch(start_patches(cloud)[0])
    assert size.length == pytest.approx(2, rel=0.08)
    assert size.half_width == pytest.approx(0.1, rel=0.35)


def test_starts_do_not_turn_on_which_of_equally_near_voxels_is_nearest() -> None:
    """A bent strip of voxels: on a lattice most distances tie, and rounding decides nothing."""
    x, y, z = (a.ravel() for a in np.meshgrid(np.arange(60), np.arange(9), np.arange(12), indexing="ij"))
    is_blade = np.abs(z - 10 * np.sin(x / 59 * np.pi)) < 1.5
    voxels = 0.1 * np.stack([x, y, z], 1)[is_blade]
    given = patch_grid(12, 5).points(start_patches(voxels)[0])
    rng = np.random.default_rng(0)
    for _ in range(5):
        moved = patch_grid(12, 5).points(start_patches(voxels + rng.uniform(-1e-12, 1e-12, voxels.shape))[0])
        assert min(np.abs(moved - mirrored).max() for mirrored in (given, given[:, ::-1])) < 1e-6


def test_clouds_have_eight_starts_and_points_on_a_line_none() -> None:
    angle, radius = (a.ravel() for a in np.meshgrid(np.linspace(0, 6.2, 40), np.linspace(0.1, 1, 9)))
    disc = np.stack([radius * np.cos(angle), 0.9 * radius * np.sin(angle), 0 * angle], 1)
    assert len(start_patches(disc)) == 8
    for few in (disc[:0], disc[:1], disc[[0, 9, 9]], np.ones((40, 3))):
        assert start_patches(few) == []
    assert all(np.isfinite(start).all() for start in start_patches(disc[:3]))
