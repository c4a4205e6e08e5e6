from __future__ import annotations

import numpy as np
import pytest
import torch

from blade_scene import SIZE, ring_cameras
from known_leaves import bent_blade, fit_coefficients, flat_leaf, flat_sheet, make_surface
from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import NUM_COEFFICIENTS, measure_patch, patch_grid
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface
from mvseg.reconstruction.surface.patch_image import draw_polygons, grid_quads


def area_and_length(coefficients: Floats) -> Floats:
    points = patch_grid(24, 9).points(coefficients)
    first, second = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    area = np.linalg.norm(np.cross(first, second), axis=-1).sum() / 2
    return np.array([area, measure_patch(coefficients).length])


def random_covariance(sd: float) -> torch.Tensor:
    factors = np.random.default_rng(4).normal(size=(3 * NUM_COEFFICIENTS, 3 * NUM_COEFFICIENTS)) * sd / 9
    return torch.from_numpy(factors @ factors.T)


def one_by_one(coefficients: np.ndarray) -> np.ndarray:
    return np.stack([area_and_length(each) for each in coefficients])


def test_deviations_are_those_of_samples() -> None:
    """The naive twin: measure leaves drawn from the covariance, whose errors are correlated."""
    coefficients = bent_blade().coefficients.numpy()
    surface = make_surface(coefficients)
    object.__setattr__(surface, "covariance", random_covariance(0.05))
    draws = np.random.default_rng(5).multivariate_normal(coefficients.ravel(), surface.covariance.numpy(), 4000)
    measured = np.stack([area_and_length(draw.reshape(-1, 3)) for draw in draws])
    assert surface.deviation(one_by_one) == pytest.approx(measured.std(0), rel=0.06)


def test_sizes_of_a_leaf_of_unknown_scale() -> None:
    """Lengths are as uncertain as the scale, and areas twice as much."""
    coefficients = fit_coefficients(flat_sheet, length=30, half_width=9) + 0.02 * np.arange(3)
    surface = make_surface(coefficients)
    object.__setattr__(surface, "covariance", torch.from_numpy(0.03**2 * np.outer(coefficients, coefficients)))
    expected = 0.03 * np.array([2 * surface.area, surface.length, surface.width])
    assert surface.deviations == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_deviations_of_a_linear_measure_are_exact_in_any_unit(factor: float) -> None:
    surface = make_surface(factor * bent_blade().coefficients.numpy() + 1e3 * factor, sd=factor)
    deviation = surface.deviation(lambda coefficients: coefficients.sum(1)[:, :1])
    assert deviation == pytest.approx([factor * NUM_COEFFICIENTS**0.5], rel=1e-6)


def test_numbers_that_are_none_have_no_deviation() -> None:
    surface = bent_blade()
    sds = surface.deviation(lambda c: np.stack([c[:, 0, 0], np.full(len(c), np.nan)], 1))
    assert np.isfinite(sds).tolist() == [True, False]
    nothing = LeafSurface.none(torch.tensor([0]), "test", "seen in one view only")
    assert not nothing.is_credible
    assert surface.is_credible
    assert np.isnan(nothing.deviation(one_by_one)).all()


def test_parts_are_what_whole_frames_show() -> None:
    """Slow twin: all polygons drawn into the whole frame; of leaves inside it, across its border, beside and behind."""
    cameras = ring_cameras(3)
    for at in ((-0.5, 0.1, 0.0), (0.6, 0.8, 0.3), (30.0, 0.0, 0.0), (0.0, 0.0, 12.0)):
        leaf = flat_leaf(length=1.3, half_width=0.4, at=at)
        px, depth = cameras.project(leaf.points().reshape(-1, 3))
        for view, (mask, part) in enumerate(zip(leaf.project(cameras), leaf.project_parts(cameras), strict=True)):
            is_ahead = (grid_quads(depth[view].reshape(*MESH_SHAPE, 1).numpy()) > 0).all((1, 2))
            quads = grid_quads(px[view].reshape(*MESH_SHAPE, 2).numpy())[is_ahead]
            whole = draw_polygons(quads, (SIZE, SIZE), np.zeros(2)) >= 0.5
            np.testing.assert_array_equal(mask.numpy(), whole)
            np.testing.assert_array_equal(part.pixels.numpy(), part.cut(whole))
            assert part.area == whole.sum()
        first, last = leaf.project_parts(cameras[[2, 0]])  # not drawn again
        assert first is leaf.project_parts(cameras)[2]
        assert last is leaf.project_parts(cameras)[0]
