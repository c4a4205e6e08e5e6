"""Laws of similarities: what was applied comes back, from any points, in any order, with wrong ones among them."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError
from mvseg.poses.alignment import align, fit_similarity, is_one_line, scale_by, spreads

SEEDS = range(2)


def draw(seed: int, num_points: int = 12) -> tuple[np.ndarray, pycolmap.Sim3d]:
    rng = np.random.default_rng(seed)
    similarity = pycolmap.Sim3d(
        float(10 ** rng.uniform(-3, 3)),
        pycolmap.Rotation3d(Rotation.random(random_state=seed).as_matrix()),
        rng.normal(size=3) * 100,
    )
    return rng.normal(size=(num_points, 3)), similarity


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("fit", [fit_similarity, lambda source, target: align(source, target).similarity])
@pytest.mark.parametrize("is_flat", [False, True])
def test_any_similarity_comes_back(seed: int, fit, is_flat: bool) -> None:
    points, similarity = draw(seed)
    if is_flat:
        points[:, 2] = 0
    found = fit(points, similarity * points)
    assert found.scale == pytest.approx(similarity.scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation.matrix(), similarity.rotation.matrix(), atol=1e-8)
    np.testing.assert_allclose(found * points, similarity * points, atol=1e-7 * similarity.scale)
    np.testing.assert_allclose(found.matrix()[:, :3] @ points[0] + found.matrix()[:, 3], (found * points[:1])[0])


def test_it_is_the_least_squares_fit() -> None:
    """No similarity nearby has a smaller sum of squares: the gradient by finite differences is 0."""
    points, similarity = draw(3)
    target = similarity * points + np.random.default_rng(0).normal(size=points.shape) * 0.1 * similarity.scale
    found = fit_similarity(points, target)

    def cost(step: np.ndarray) -> float:
        turn = pycolmap.Rotation3d(step[:3]) * found.rotation
        moved = pycolmap.Sim3d(found.scale * np.exp(step[3]), turn, found.translation + step[4:] * found.scale)
        return float(((moved * points - target) ** 2).sum()) / found.scale**2

    steps = np.eye(7) * 1e-4
    gradient = [(cost(step) - cost(-step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(gradient, 0, atol=1e-4)
    assert all(cost(sign * 100 * step) > cost(0 * step) for step in steps for sign in (1, -1))


@pytest.mark.parametrize("seed", SEEDS)
def test_wrong_targets_are_left_out(seed: int) -> None:
    points, similarity = draw(seed, 30)
    rng = np.random.default_rng(seed)
    target = similarity * points + similarity.scale * 1e-3 * rng.normal(size=points.shape)
    target[:9] += similarity.scale * rng.normal(size=(9, 3))
    found = align(points, target)
    assert found.similarity.scale == pytest.approx(similarity.scale, rel=2e-3)
    assert found.is_inlier[9:].all()
    assert not found.is_inlier[:9].any()
    assert found.rms == pytest.approx(similarity.scale * 1e-3 * np.sqrt(3), rel=0.3)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("num_points", [4, 12])
def test_left_handed_axes_are_refused(seed: int, num_points: int) -> None:
    points, similarity = draw(seed, num_points)
    target = (similarity * points) * np.array([1, -1, 1])
    target += 1e-3 * similarity.scale * np.random.default_rng(seed).normal(size=points.shape)
    for fit in (fit_similarity, align):
        with pytest.raises(InputError, match="points are mirrored"):
            fit(points, target)


def test_noise_of_flat_points_is_no_mirror() -> None:
    points, similarity = draw(0)
    points[:, 2] *= 1e-3
    target = similarity * points + similarity.scale * 1e-2 * np.random.default_rng(1).normal(size=points.shape)
    assert align(points, target).similarity.scale == pytest.approx(similarity.scale, rel=0.02)


@pytest.mark.parametrize("fit", [fit_similarity, align])
@pytest.mark.parametrize("num_points", [3, 8])
def test_points_on_one_line_are_refused(fit, num_points: int) -> None:
    line = np.outer(np.arange(num_points), [1.0, 2.0, 3.0])
    assert is_one_line(line)
    with pytest.raises(InputError, match="on one line"):
        fit(line, 2 * line)


@pytest.mark.parametrize("fit", [fit_similarity, align])
def test_two_points_are_too_few(fit) -> None:
    with pytest.raises(InputError, match="2 known points, expected at least three"):
        fit(np.eye(3)[:2], np.eye(3)[:2])


def test_spreads_and_scales() -> None:
    corners = np.array([[x, y, z] for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])
    np.testing.assert_allclose(spreads(corners), [3, 2, 1])
    assert is_one_line(np.zeros((5, 3)))
    assert not is_one_line(corners)
    np.testing.assert_allclose(scale_by(2) * corners, 2 * corners)
