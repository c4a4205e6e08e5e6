from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from blade_scene import SIZE, EllipticBlade, blade_masks, ring_cameras
from mvseg.reconstruction.surface import photo_consistency
from mvseg.reconstruction.surface.leaf_patch import CURL, MIDRIB, NUM_COEFFICIENTS, SIDE, Floats
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.reconstruction.surface.photo_consistency import (
    ROBUST,
    WEIGHT,
    Comparison,
    _sample,
    compare_views,
    crop_photos,
    photo_equations,
    photo_residuals,
)

CAMERAS = ring_cameras(6)
STEP_PX = 3.0


def flat_patch() -> Floats:
    """From x = -1 to 1 in the plane z = 0, a little bent so that no derivative is zero by chance."""
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB, 0] = np.linspace(-1, 1, 7)
    coefficients[SIDE, 1] = 0.45
    coefficients[CURL, 2] = 0.03
    return coefficients


def blade_stack() -> MaskStack:
    masks = blade_masks(EllipticBlade(), CAMERAS)
    px_from_world = CAMERAS.K.numpy() @ np.concatenate([CAMERAS.R.numpy(), CAMERAS.t.numpy()[:, :, None]], 2)
    nothing = [np.zeros((SIZE, SIZE), np.int32)] * len(masks)
    return stack_masks(masks, nothing, range(len(masks)), px_from_world=px_from_world)


def smooth_photos(blur_px: float) -> list[np.ndarray]:
    noise = np.random.default_rng(4).standard_normal((len(CAMERAS), SIZE, SIZE))
    smooth = ndimage.gaussian_filter(noise, (0, blur_px, blur_px))
    grey = np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return list(np.repeat(grey[..., None], 3, -1))


def compared(coefficients: Floats, *, blur_px: float = 5.0) -> Comparison:
    stack, photos = blade_stack(), smooth_photos(blur_px)
    crops = crop_photos({1: stack}, photos.__getitem__, sizes=CAMERAS.sizes.tolist())[1]
    return compare_views(stack, crops, coefficients, step_px=STEP_PX)


def test_samples_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((9, 7, 2)).astype(np.float32)
    local = rng.uniform(0, [6, 8], (50, 2))
    for channel in range(2):
        expected = ndimage.map_coordinates(image[..., channel], local.T[::-1], order=1)
        np.testing.assert_allclose(_sample(image, local)[:, channel], expected, atol=1e-5)


def test_slopes_are_finite_differences() -> None:
    """Of a texture that is finer than the window: slopes leave out that its mean and deviation change as well."""
    coefficients = flat_patch()
    comparison = compared(coefficients, blur_px=2.5)
    residuals = photo_residuals(comparison, coefficients)
    move = 1e-3 * np.random.default_rng(1).standard_normal(coefficients.shape)
    move[MIDRIB] = 0
    ahead, back = (photo_residuals(comparison, coefficients + side * move).value for side in (1, -1))
    numeric = (ahead - back) / 2
    linear = -(residuals.slope * (comparison.grid.basis @ move)).sum(2)
    counts = residuals.weight > 0
    assert np.corrcoef(numeric[counts], linear[counts])[0, 1] > 0.9
    assert np.polyfit(linear[counts], numeric[counts], 1)[0] == pytest.approx(1, abs=0.1)


def test_equations_are_those_of_the_dense_jacobian() -> None:
    coefficients = flat_patch()
    comparison = compared(coefficients)
    residuals, equations = photo_residuals(comparison, coefficients), photo_equations(comparison, coefficients)
    rows = residuals.slope[..., None, :] * comparison.grid.basis[:, :, None]
    jacobian, value = rows.reshape(-1, 3 * NUM_COEFFICIENTS), residuals.value.ravel()
    scale = WEIGHT * comparison.spacing**2 * max(0.0, residuals.agreement)
    weight = scale * residuals.weight.ravel() / (1 + (value / ROBUST) ** 2)
    np.testing.assert_allclose(equations.matrix, jacobian.T @ (weight[:, None] * jacobian), atol=1e-9)
    np.testing.assert_allclose(equations.right, jacobian.T @ (weight * value), atol=1e-9)


def test_points_near_the_rim_of_a_mask_and_seen_obliquely_do_not_count() -> None:
    coefficients = flat_patch()
    comparison = compared(coefficients)
    points = comparison.grid.basis @ coefficients
    assert comparison.is_upper.all()
    seen = comparison.weight.max(0) > 0
    inside = (points[:, 0] ** 2 + (points[:, 1] / 0.45) ** 2) < 0.7
    assert seen[inside].all()
    low = comparison.weight[[0, 3]][:, inside]  # at 25 degrees: the sine is 0.42
    high = comparison.weight[[1, 4]][:, inside]  # at 60 degrees
    assert 0 < low[low > 0].mean() < 0.9
    assert high.min() == 1


def test_part_that_another_part_hides_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """One half of the blade is rolled back over the other one, high enough to be told from it."""
    coefficients = flat_patch()
    coefficients[SIDE, 1] = 0.15
    coefficients[CURL] = [0, 0.2, 0.25]
    rolled = compared(coefficients)
    monkeypatch.setattr(photo_consistency, "BEHIND", np.inf)
    transparent = compared(coefficients)
    hidden = (rolled.weight == 0) & (transparent.weight > 0)
    assert hidden.any()
    heights = np.broadcast_to((rolled.grid.basis @ coefficients)[:, 2], hidden.shape)
    assert heights[hidden].max() < 0.1
    assert heights[rolled.weight > 0].max() > 0.15


def test_views_that_show_different_things_agree_on_nothing() -> None:
    coefficients = flat_patch()
    assert abs(photo_residuals(compared(coefficients, blur_px=2.0), coefficients).agreement) < 0.1
