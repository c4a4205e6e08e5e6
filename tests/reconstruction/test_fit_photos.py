"""A domed blade whose outlines, from above, are those of a flat one: only its texture tells the two apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy import ndimage

from blade_scene import SIZE, as_regions, ring_cameras
from mvseg.errors import InputError
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras

HALF_LENGTH, HALF_WIDTH, HEIGHT = 1.0, 0.45, 0.06
CAMERAS = ring_cameras(8)  # at 25 degrees and more; the dome is nowhere as steep, so its rim is the outline
BELOW = Cameras(  # the same cameras under the blade, upside down
    K=CAMERAS.K,
    R=CAMERAS.R @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=CAMERAS.R.dtype)),
    t=CAMERAS.t,
    sizes=CAMERAS.sizes,
)


@dataclass(frozen=True, eq=False)
class Shot:
    """What V cameras see: masks (H, W) bool and photos (H, W, 3) uint8."""

    masks: list[np.ndarray]
    photos: list[np.ndarray]


def texture(seed: int) -> np.ndarray:
    """(400, 400) smooth noise, 0 to 255: a hundred texels are one world unit, blobs are some five pixels wide."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((400, 400)), 4, mode="wrap")
    return np.clip(128 + 40 * noise / noise.std(), 0, 255)


def photograph(cameras: Cameras, paint: np.ndarray, *, height: float = HEIGHT) -> Shot:
    """z = height (1 - x^2 / a^2 - y^2 / b^2) >= 0, painted from above: exact rays through the pixels' centres."""
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ cameras.world_from_px.numpy().transpose(0, 2, 1)[:, None]
    centers = cameras.centers.numpy()[:, None, None]
    axes = np.array([HALF_LENGTH, HALF_WIDTH])
    o, d = centers[..., :2] / axes, rays[..., :2] / axes
    depth = -centers[..., 2] / rays[..., 2]
    for _ in range(50):  # where the ray is as high as the dome; the dome is much flatter than the rays
        high = height * np.maximum(0, 1 - ((o + depth[..., None] * d) ** 2).sum(-1))
        depth = (high - centers[..., 2]) / rays[..., 2]
    points = centers + depth[..., None] * rays
    masks = ((points[..., :2] / axes) ** 2).sum(-1) <= 1
    texels = np.moveaxis(points[..., 1::-1] * 100 + 200, -1, 0)
    grey = np.where(masks, ndimage.map_coordinates(paint, texels, order=1, mode="wrap"), 30)
    photos = np.repeat(np.round(grey)[..., None], 3, -1).astype(np.uint8)
    return Shot(list(masks), list(photos))


PAINT = texture(0)
DOME = photograph(CAMERAS, PAINT)


def fit(masks: list[np.ndarray], photos: list[np.ndarray] | None, cameras: Cameras = CAMERAS) -> LeafSurface:
    regions, ids = as_regions(masks)
    return fit_surfaces(regions, ids, cameras, photos=None if photos is None else photos.__getitem__)[1]


def middle(surface: LeafSurface) -> float:
    """Height of the blade's middle above its rim, over that of the dome: 1 for the truth, 0 for a flat blade."""
    points = surface.points(65, 17)
    return float(points[32, 8, 2] - points[32, [0, -1], 2].mean()) / HEIGHT


@pytest.fixture(scope="module")
def outlined() -> LeafSurface:
    """From the outlines alone."""
    return fit(DOME.masks, None)


@pytest.fixture(scope="module")
def textured() -> LeafSurface:
    return fit(DOME.masks, DOME.photos)


def test_texture_raises_the_dome_that_no_outline_shows(outlined: LeafSurface, textured: LeafSurface) -> None:
    assert abs(middle(outlined)) < 0.3
    assert middle(textured) == pytest.approx(1, abs=0.1)


def test_flat_blade_stays_flat() -> None:
    flat = photograph(CAMERAS, PAINT, height=0.0)
    assert abs(middle(fit(flat.masks, flat.photos))) < 0.1


def test_outline_stays_where_it_is(outlined: LeafSurface, textured: LeafSurface) -> None:
    assert float((textured.residual_px - outlined.residual_px).max()) < 0.1
    assert textured.length == pytest.approx(outlined.length, rel=0.04)


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_without_texture_nothing_changes(outlined: LeafSurface, noise: float) -> None:
    rng = np.random.default_rng(1)
    photos = [np.clip(120 + noise * rng.standard_normal(p.shape), 0, 255).astype(np.uint8) for p in DOME.photos]
    assert torch.equal(fit(DOME.masks, photos).coefficients, outlined.coefficients)


@pytest.mark.slow
def test_views_that_do_not_agree_change_nothing(outlined: LeafSurface) -> None:
    photos = [photograph(CAMERAS, texture(10 + view)).photos[view] for view in range(len(CAMERAS))]
    assert torch.equal(fit(DOME.masks, photos).coefficients, outlined.coefficients)


def test_gain_and_offset_of_each_view_do_not_matter(textured: LeafSurface) -> None:
    gains = np.random.default_rng(2).uniform(0.5, 0.9, len(CAMERAS))
    photos = [(gain * photo + 40 * gain).astype(np.uint8) for gain, photo in zip(gains, DOME.photos, strict=True)]
    assert middle(fit(DOME.masks, photos)) == pytest.approx(middle(textured), abs=0.05)


@pytest.mark.slow
def test_the_two_sides_are_not_compared() -> None:
    cameras = Cameras(*(torch.cat([getattr(CAMERAS, n), getattr(BELOW, n)]) for n in ("K", "R", "t", "sizes")))
    upper, lower = photograph(cameras, PAINT), photograph(cameras, texture(5))
    assert len(cameras) == 16
    photos = upper.photos[:8] + lower.photos[8:]
    assert middle(fit(upper.masks, photos, cameras)) == pytest.approx(1, abs=0.1)


def test_photos_three_times_as_large_give_the_same(textured: LeafSurface) -> None:
    K = CAMERAS.K.clone()
    K[:, :2] *= 3
    cameras = Cameras(K=K, R=CAMERAS.R, t=CAMERAS.t, sizes=CAMERAS.sizes * 3)
    masks = [mask.repeat(3, 0).repeat(3, 1) for mask in DOME.masks]
    photos = [photo.repeat(3, 0).repeat(3, 1) for photo in DOME.photos]
    assert middle(fit(masks, photos, cameras)) == pytest.approx(middle(textured), abs=0.1)


@pytest.mark.parametrize("scale", [2.0**-10, 2.0**10])
def test_the_world_may_be_scaled(textured: LeafSurface, scale: float) -> None:
    """What hides what on the blade is told in its own length, not in the world's unit."""
    other = fit(DOME.masks, DOME.photos, CAMERAS.scale(scale))
    assert other.area / scale**2 == pytest.approx(textured.area, rel=1e-6)
    assert other.deviations[0] / scale**2 == pytest.approx(textured.deviations[0], rel=1e-3)


def test_photo_of_another_size_is_refused() -> None:
    photos = [*DOME.photos[:2], DOME.photos[2][:-1], *DOME.photos[3:]]
    with pytest.raises(InputError, match=r"the photo of view 2 is of shape \(199, 200, 3\), expected \(200, 200, 3\)"):
        fit(DOME.masks, photos)
