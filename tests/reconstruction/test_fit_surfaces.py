from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage

from blade_scene import SIZE, EllipticBlade, as_regions, blade_masks, ring_cameras
from known_leaves import flat_leaf
from mvseg.errors import InputError
from mvseg.reconstruction.numbers import SEARCH
from mvseg.reconstruction.spread_views import spread_views
from mvseg.reconstruction.surface.find_starts import start_in
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.hull import Hull
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.evidence import paint_view

FLAT, BENT = EllipticBlade(), EllipticBlade(bend=0.9)
CAMERAS = ring_cameras(10)


def fit(masks: list[np.ndarray], cameras: Cameras = CAMERAS) -> LeafSurface:
    regions, ids = as_regions(masks)
    return fit_surfaces(regions, ids, cameras)[1]


def errors(surface: LeafSurface, blade: EllipticBlade) -> np.ndarray:
    """Relative errors of area, length and width."""
    found = np.array([surface.area, surface.length, surface.width])
    return found / [blade.area, 2 * blade.half_length, 2 * blade.half_width] - 1


@pytest.fixture(scope="module")
def bent() -> LeafSurface:
    return fit(blade_masks(BENT, CAMERAS))


def test_flat_and_bent_blades_have_their_areas_lengths_and_widths(bent: LeafSurface) -> None:
    surface = fit(blade_masks(FLAT, CAMERAS))
    assert np.abs(errors(surface, FLAT)).max() < 0.012
    assert abs(float(surface.normal[2])) > 0.999
    assert not surface.reasons
    assert float(surface.points()[..., 2].abs().max()) < 0.03
    assert np.abs(errors(bent, BENT)).max() < 0.015
    middle = bent.midrib[len(bent.midrib) // 2]
    drop = BENT.bend * (np.cos(1 / BENT.bend) - 1)
    assert float(middle.norm()) < 0.04
    assert np.abs(bent.midrib[[0, -1], 2].numpy() - drop).max() < 0.04
    assert (np.abs(np.array(bent.deviations) / [bent.area, bent.length, bent.width]) < 0.05).all()


@pytest.mark.parametrize("num_views", [6, 11])
def test_midrib_of_a_disc_does_not_wind(num_views: int) -> None:
    """The outline does not tell where it runs: it is a diameter."""
    cameras = ring_cameras(num_views, elevations_deg=(15, 50, 32))
    disc = EllipticBlade(half_width=1.0)
    surface = fit(blade_masks(disc, cameras), cameras)
    assert np.abs(errors(surface, disc)).max() < 0.008
    assert float((surface.midrib[-1] - surface.midrib[0]).norm()) > 0.995 * surface.length


def test_surface_covers_the_masks_that_it_was_fitted_to(bent: LeafSurface) -> None:
    for seen, mask in zip(bent.project(CAMERAS), blade_masks(BENT, CAMERAS), strict=True):
        assert (seen.numpy() & mask).sum() / (seen.numpy() | mask).sum() > 0.95
    assert float(bent.iou.min()) > 0.95
    assert float(bent.residual_px.max()) < 0.4


def test_order_of_the_views_does_not_matter_and_the_world_may_be_moved_turned_and_scaled(bent: LeafSurface) -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn = torch.from_numpy(turn * np.sign(np.linalg.det(turn)))
    scale, shift = 250.0, torch.tensor([4000.0, -300.0, 80.0], dtype=torch.float64)
    R = CAMERAS.R @ turn.T
    t = scale * CAMERAS.t - R @ shift
    order, masks = [3, 7, 0, 9, 1, 8, 2, 6, 4, 5], blade_masks(BENT, CAMERAS)
    moved = Cameras(K=CAMERAS.K, R=R, t=t, sizes=CAMERAS.sizes)
    other = fit([masks[view] for view in order], moved[order])
    assert other.area / scale**2 == pytest.approx(bent.area, rel=5e-3)
    assert other.length / scale == pytest.approx(bent.length, rel=5e-3)
    assert other.width / scale == pytest.approx(bent.width, rel=5e-3)
    middle = turn @ bent.points().mean((0, 1)) * scale + shift
    assert float((other.points().mean((0, 1)) - middle).norm()) < 0.01 * other.length


def test_of_very_many_views_some_are_looked_at() -> None:
    """Slow twin: the fit to these views alone."""
    regions, ids = as_regions(blade_masks(BENT, CAMERAS))
    surface = fit_surfaces(regions, ids, CAMERAS, most_views=6)[1]
    assert torch.equal(surface.views, spread_views(CAMERAS, 6))
    kept = torch.isin(regions.view_index, surface.views)
    same = fit_surfaces(regions.select(kept), ids[kept], CAMERAS)[1]
    assert torch.equal(surface.coefficients, same.coefficients)


def test_a_known_start_saves_the_search_for_one(bent: LeafSurface, monkeypatch: pytest.MonkeyPatch) -> None:
    regions, ids = as_regions(blade_masks(BENT, CAMERAS))
    rough = fit_surfaces(regions, ids, CAMERAS, most_views=4)
    monkeypatch.setattr("mvseg.reconstruction.surface.find_starts.carve_hull", None)
    surface = fit_surfaces(regions, ids, CAMERAS, starts=rough)[1]
    assert surface.area == pytest.approx(bent.area, rel=5e-3)
    assert surface.length == pytest.approx(bent.length, rel=5e-3)
    assert np.abs(errors(surface, BENT)).max() < 0.015


def test_a_rough_fit_is_the_first_of_two_and_nearly_as_good(bent: LeafSurface, monkeypatch: pytest.MonkeyPatch) -> None:
    regions, ids = as_regions(blade_masks(BENT, CAMERAS))
    monkeypatch.setattr("mvseg.reconstruction.surface.fit_surfaces._fit_again", None)
    rough = fit_surfaces(regions, ids, CAMERAS, is_rough=True)
    assert rough[1].is_credible
    assert rough[1].area == pytest.approx(bent.area, rel=0.02)
    assert np.abs(errors(rough[1], BENT)).max() < 0.03


def test_one_wrong_mask_in_five_does_little_harm() -> None:
    masks = blade_masks(BENT, CAMERAS)
    for view, step in ((2, (25, 10)), (6, (-20, 30))):
        masks[view] = np.roll(ndimage.binary_dilation(masks[view], iterations=4), step, (0, 1))
    assert np.abs(errors(fit(masks), BENT)).max() < 0.05


def test_masks_of_another_leaf_are_left_out() -> None:
    masks = blade_masks(BENT, CAMERAS)
    for view in (2, 6):
        masks[view] = np.zeros_like(masks[view])
        masks[view][150:185, 20:60] = True
    surface = fit(masks)
    assert np.abs(errors(surface, BENT)).max() < 0.02
    assert surface.views.tolist() == [0, 1, 3, 4, 5, 7, 8, 9]


def test_masks_too_large_in_one_view_and_too_small_in_another_cancel() -> None:
    masks = blade_masks(BENT, CAMERAS)
    for view, mask in enumerate(masks):
        masks[view] = ndimage.binary_dilation(mask) if view % 2 else ndimage.binary_erosion(mask)
    assert np.abs(errors(fit(masks), BENT)).max() < 0.03


class Star(EllipticBlade):
    """Five lobes."""

    def contains(self, points: np.ndarray) -> np.ndarray:
        angle = np.arctan2(points[..., 1], points[..., 0])
        return np.hypot(points[..., 0], points[..., 1]) <= 1 - 0.45 * (1 - np.abs(np.cos(2.5 * angle)))


class Rectangle(EllipticBlade):
    """Three times as long as wide."""

    def contains(self, points: np.ndarray) -> np.ndarray:
        return (np.abs(points[..., 0]) <= 1) & (np.abs(points[..., 1]) <= 0.33)


def test_shapes_that_no_patch_has() -> None:
    """The bays of a star are no part of its area; where a rectangle ends is doubted."""
    star = fit(blade_masks(Star(), CAMERAS))
    assert not star.reasons
    assert star.area == pytest.approx(2.2584, rel=0.02)  # the integral of r^2 / 2
    assert star.mesh().area == pytest.approx(star.area, rel=0.03)
    assert [*fit(blade_masks(Rectangle(), CAMERAS)).reasons] == ["blunt_end"]


def test_masks_that_no_blade_explains_give_no_credible_surface() -> None:
    """Two stars of four arms about one point in space: of their masks the patch covers little."""
    rng = np.random.default_rng(0)
    masks = [rng.random(mask.shape) < 0.3 for mask in blade_masks(FLAT, CAMERAS)]
    masks = [mask & blade for mask, blade in zip(masks, blade_masks(FLAT, CAMERAS), strict=True)]
    surface = fit(masks)
    assert not surface.is_credible
    assert surface.reasons


def half_hidden() -> list[np.ndarray]:
    """Label maps in which something hides one half of the blade in four of ten views."""
    maps = [mask.astype(np.int64) for mask in blade_masks(BENT, CAMERAS)]
    for view in (0, 3, 5, 8):
        columns = np.flatnonzero(maps[view].any(0))
        hidden = np.zeros((SIZE, SIZE), bool)
        hidden[:, int(columns.mean()) :] = True
        maps[view][hidden] = 2
    return maps


@pytest.mark.parametrize("hides", [2, -1])
def test_another_instance_or_a_mask_matched_to_nothing_may_hide_half_of_the_leaf(hides: int) -> None:
    regions, ids = as_regions(half_hidden())
    surface = fit_surfaces(regions, torch.where(ids == 2, hides, ids), CAMERAS)[1]
    assert np.abs(errors(surface, BENT)).max() < 0.03


def test_two_views_say_so() -> None:
    masks = blade_masks(BENT, CAMERAS)
    surface = fit([masks[0], masks[2]], CAMERAS[[0, 2]])
    assert surface.reasons
    assert "two_views" in surface.reasons


@pytest.mark.parametrize("size", [1e-3, 0.37, 1 / 3, 1e3])
def test_starts_do_not_depend_on_the_size_of_a_voxel(size: float) -> None:
    """Voxels have many neighbours that are equally near; rounding must not choose between them."""
    x, y, z = np.mgrid[:30, :20, :9]
    blob = (x - 15) ** 2 / 200 + (y - 9 - x / 5) ** 2 / 30 + (z - 4 - y / 9) ** 2 / 6 <= 1
    voxels, corner = np.argwhere(blob), np.array([-7.0, 3.0, 5.0])
    hulls = [Hull(voxels, np.ones(len(voxels), bool), corner=corner * each, size=each) for each in (1.0, size)]
    starts, scaled = (np.array(start_in(hull)) for hull in hulls)
    assert scaled / size == pytest.approx(starts, rel=1e-9, abs=1e-9)


def test_one_view_or_no_common_point_gives_no_surface() -> None:
    masks = blade_masks(BENT, CAMERAS)
    surface = fit([masks[0], np.zeros_like(masks[0])], CAMERAS[[0, 2]])
    assert surface.reasons == {"one_view": "seen in one view only"}
    assert not surface.exists
    assert np.isnan([surface.area, surface.length, surface.width, *surface.deviations]).all()
    assert len(surface.mesh().faces) == 0
    assert not any(mask.any() for mask in surface.project(CAMERAS))
    masks = [np.zeros((SIZE, SIZE), bool) for _ in range(2)]
    masks[0][:20, :20], masks[1][-20:, -20:] = True, True
    surface = fit(masks, CAMERAS[[0, 1]])
    assert [*surface.reasons] == ["no_common_point"]


@pytest.mark.parametrize(("kind", "num_views"), [("line", 3), ("line", 6), ("level line", 3), ("ring", 6), ("salt", 3)])
def test_masks_of_a_pixel_give_no_surface_that_is_trusted(kind: str, num_views: int) -> None:
    """Their hulls are flat, or of a few voxels: no start of such a one may divide by its width or length."""
    cameras, rng = ring_cameras(num_views), np.random.default_rng(0)
    masks = np.zeros((num_views, SIZE, SIZE), np.uint8)
    ends = cameras.project(torch.tensor([[-0.5, 0.2, 0.1], [0.6, -0.3, 0.2]], dtype=torch.float64))[0].int().tolist()
    for mask, ((x, y), end) in zip(masks, ends, strict=True):
        if kind == "ring":
            cv2.circle(mask, (x, y), 12, 1)
        elif kind == "salt":
            mask[y - 15 : y + 15, x - 15 : x + 15] = rng.random((30, 30)) < 0.2
        else:
            cv2.line(mask, (x, y), (end[0], y) if kind == "level line" else tuple(end), 1)
    surface = fit(list(masks), cameras)
    assert not surface.is_credible
    assert surface.reasons


def test_a_start_that_no_mask_is_near_gives_no_surface() -> None:
    """Nothing but the prior is left, whose equations are singular: that is an answer, and no exception."""
    regions, ids = as_regions(blade_masks(FLAT, CAMERAS[:4]))
    far = flat_leaf(at=(500.0, 0.0, 0.0))
    surface = fit_surfaces(regions, ids, CAMERAS[:4], starts={1: far})[1]
    assert not surface.exists
    assert not surface.is_credible
    assert [*surface.reasons] == ["shape_unknown"]


def test_no_regions_give_no_surfaces() -> None:
    regions, ids = as_regions([np.zeros((SIZE, SIZE), bool)] * 2)
    assert fit_surfaces(regions, ids, CAMERAS[[0, 1]]) == {}
    regions, ids = as_regions(blade_masks(FLAT, CAMERAS))
    with pytest.raises(InputError, match="9 instance ids for 10 regions"):
        fit_surfaces(regions, ids[:9], CAMERAS)


def test_cameras_that_all_look_down_show_a_level_leaf() -> None:
    """Its hull is as thick as it is wide: only the fit tells that the leaf does not stand upright."""
    cameras = ring_cameras(8, elevations_deg=(45,), arc_deg=144)
    surface = fit(blade_masks(FLAT, cameras), cameras)
    assert abs(float(surface.normal[2])) > 0.99
    assert np.abs(errors(surface, FLAT)).max() < 0.02


@pytest.mark.parametrize("is_rough", [True, False])
def test_leaves_that_are_searched_side_by_side_are_those_of_each_alone(
    is_rough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Slow twin: one after the other, to the bit. Their crops are of different sizes, and one has fewer masks."""
    cameras = CAMERAS[[0, 2, 5, 7]]
    leaves = {1: flat_leaf(length=1.4, half_width=0.3, at=(-0.7, -0.2, 0.3)),
              2: flat_leaf(length=0.8, half_width=0.35, at=(-0.6, 0.1, 0.0))}  # fmt: skip
    maps = [paint_view(leaves, cameras, view) for view in range(len(cameras))]
    maps[1][maps[1] == 2] = 0
    regions, ids = as_regions(maps)
    together = fit_surfaces(regions, ids, cameras, is_rough=is_rough)
    monkeypatch.setattr("mvseg.reconstruction.surface.fit_surfaces.SEARCH", replace(SEARCH, at_once=1))
    for instance, alone in fit_surfaces(regions, ids, cameras, is_rough=is_rough).items():
        assert torch.equal(together[instance].coefficients, alone.coefficients)
        assert torch.equal(together[instance].covariance, alone.covariance)
        assert together[instance].reasons == alone.reasons
