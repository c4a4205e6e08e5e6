from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.faults import disc
from blade_scene import SIZE, EllipticBlade, blade_masks, ring_cameras
from mvseg.reconstruction.numbers import FIT, IMAGE, STACK
from mvseg.reconstruction.surface.fit_patch import fit_patches, invert_normal
from mvseg.reconstruction.surface.leaf_patch import (
    COUNTS,
    MIDRIB,
    NUM_COEFFICIENTS,
    SIDE,
    Floats,
    measure_patch,
    patch_grid,
    patch_prior,
)
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.reconstruction.surface.outline import nearest_samples, outline_distances, outline_samples, search_edges
from mvseg.reconstruction.surface.patch_image import (
    cover_crops,
    crop_ious,
    draw_polygons,
    fill_grids,
    grid_orientations,
    grid_quads,
    hiding_pixels,
    project_points,
)
from reference import nearest_edge_reference

CAMERAS = ring_cameras(4)
GRID = patch_grid(36, 9)
NOTHING = np.zeros((SIZE, SIZE), np.int32)
OFFSETS_PX = np.array([-2.0, 2.0, -2.0, 2.0])


def matrices() -> Floats:
    pose = np.concatenate([CAMERAS.R.numpy(), CAMERAS.t.numpy()[:, :, None]], 2)
    return CAMERAS.K.numpy() @ pose


def ellipse(half_length: float = 1.0, half_width: float = 0.45, height: float = 0.0) -> Floats:
    """A patch whose midrib is even in the cosine of the ellipse: exactly (cos, sin) at the rim."""
    coefficients = np.zeros((NUM_COEFFICIENTS, 3))
    coefficients[MIDRIB, 0] = half_length * np.array([-1, -5 / 6, -1 / 2, 0, 1 / 2, 5 / 6, 1])
    coefficients[MIDRIB, 2] = height
    coefficients[SIDE, 1] = half_width
    assert COUNTS[0] == 7
    return coefficients


def stack(others: list[np.ndarray] | None = None) -> MaskStack:
    masks = blade_masks(EllipticBlade(), CAMERAS)
    hiding = others or [NOTHING] * len(masks)
    masks = [mask & (other == 0) for mask, other in zip(masks, hiding, strict=True)]
    return stack_masks(masks, hiding, range(len(masks)), px_from_world=matrices())


@pytest.mark.parametrize("is_imaged", [False, True])
def test_a_patch_in_its_place_has_no_distance(is_imaged: bool) -> None:
    distances = outline_distances(stack(), GRID, ellipse(), reach=6.0, is_imaged=is_imaged)
    assert len(distances.px) > 4 * 60
    assert np.abs(np.median(distances.px)) < 0.06
    assert np.quantile(np.abs(distances.px), 0.9) < 0.5


def test_a_patch_that_is_too_small_has_to_grow_by_the_difference() -> None:
    """Slow twin: distance from each projected rim point to the densely sampled true rim."""
    masks, small = stack(), ellipse(0.9, 0.36)
    distances = outline_distances(masks, GRID, small, reach=14.0, is_imaged=False)
    forth = distances.weight == 1
    angle = np.linspace(0, 2 * np.pi, 4000)
    rim = np.stack([np.cos(angle), 0.45 * np.sin(angle), 0 * angle], 1)
    points = GRID.outline_basis[distances.place[forth]] @ small
    for view in range(len(masks)):
        here = distances.stack[forth] == view
        true, seen = (project_points(masks.px_from_world[[view]], x[None]).px[0, 0] for x in (rim, points[here]))
        nearest = np.sqrt(((seen[:, None] - true) ** 2).sum(2)).min(1)
        off = distances.px[forth][here] - nearest
        assert np.abs(np.median(off)) < 0.15
        assert (distances.px[forth][here] > 0).all()


def test_gradients_are_what_moving_the_patch_does() -> None:
    """Slow twin: each gradient is a unit normal times the change of the pixel position, by differences."""
    masks, patch, step = stack(), ellipse(0.97, 0.42), 1e-6
    distances = outline_distances(masks, GRID, patch, reach=6.0, is_imaged=False)
    for sample in range(0, len(distances.px), 9):
        camera = masks.px_from_world[[distances.stack[sample]]]
        point = GRID.outline_basis[distances.place[sample]] @ patch
        corners = np.stack([point + step * axis for axis in (*np.eye(3), *-np.eye(3))])
        px = project_points(camera, corners[None]).px[0, 0]
        change = (px[:3] - px[3:]).T / (2 * step)
        normal = np.linalg.lstsq(change.T, distances.gradient[sample], rcond=None)[0]
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
        assert normal @ change == pytest.approx(distances.gradient[sample], abs=1e-4)
    row = GRID.outline_basis[distances.place[5]][:, None] * distances.gradient[5]
    assert (distances.jacobian[5] == row.ravel()).all()


def test_normal_equations_are_those_of_the_jacobian() -> None:
    """Slow twin: the products of all samples. A folded blade has samples on its rim and on its folds."""
    distances = outline_distances(stack(), GRID, bent_patch(0), reach=14.0, is_imaged=False)
    assert (distances.place >= 2 * len(GRID.basis)).any()
    weight = np.random.default_rng(0).random(len(distances.px))
    (matrix,), (right,) = distances.normal_equations(distances.px, weight)
    weighted = distances.jacobian * weight[:, None]
    assert matrix == pytest.approx(weighted.T @ distances.jacobian, rel=1e-9, abs=1e-6)
    assert right == pytest.approx(weighted.T @ distances.px, rel=1e-9, abs=1e-6)


def test_where_another_instance_hides_the_leaf_it_need_not_shrink() -> None:
    other = NOTHING.copy()
    other[:, SIZE // 2 :] = 7
    hidden, bare = stack(others=[other] * 4), stack(others=[other] * 4)
    bare = replace(bare, others=np.zeros_like(bare.others))
    with_rule = outline_distances(hidden, GRID, ellipse(), reach=14.0, is_imaged=False)
    without = outline_distances(bare, GRID, ellipse(), reach=14.0, is_imaged=False)
    assert (without.px < -5).sum() > 10
    assert (with_rule.px < -5).sum() == 0
    assert np.abs(np.median(with_rule.px)) < 0.1


def test_outline_has_no_samples_inside_the_patch() -> None:
    """A blade folded in two: the crease is an outline from the side, and its hidden rim is none."""
    folded = ellipse()
    folded[SIDE.stop : SIDE.stop + COUNTS[2], 2] = 0.4
    masks = stack()
    projection = project_points(masks.px_from_world, GRID.points(folded))
    samples, covered = outline_samples(masks, GRID, projection)
    outside = masks.look_up(covered, samples.stack, samples.px + 1.6 * samples.normals)
    assert (outside == 0).all()
    assert (np.abs(np.linalg.norm(samples.normals, axis=1) - 1) < 1e-9).all()


def test_polygons_are_too_wide_by_a_known_part_of_a_pixel() -> None:
    rng, extra = np.random.default_rng(0), []
    for _ in range(100):
        angle, (width, height) = rng.uniform(0, 2 * np.pi), rng.uniform(5, 30, 2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        corners = np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2
        share = draw_polygons((corners @ turn.T + rng.uniform(28, 32, 2))[None], (60, 60), np.zeros(2))
        extra.append((share.sum() - width * height) / (2 * (width + height)))
    assert np.mean(extra) == pytest.approx(IMAGE.drawn_too_far / IMAGE.supersampled, abs=0.02)


def bent_patch(seed: int) -> Floats:
    """Folded, curled and twisted at random: many views see both of its sides."""
    patch = ellipse()
    patch += np.random.default_rng(seed).normal(0, 0.12, patch.shape)
    patch[SIDE.stop :, 2] += 0.3
    return patch


def test_a_grid_is_drawn_as_its_quads_are() -> None:
    """Slow twin: every quad is drawn by itself."""
    masks, num_both = stack(), 0
    for seed in range(8):
        for px in project_points(masks.px_from_world, GRID.points(bent_patch(seed))).px:
            small = np.zeros((3 * SIZE, 3 * SIZE), np.uint8)
            fill_grids([small], 3 * px[None])
            slow = np.zeros_like(small)
            for quad in np.round((3 * grid_quads(px) - 0.5) * 16).astype(np.int32):
                cv2.fillConvexPoly(slow, quad, 255, shift=4)
            num_both += len(np.unique(grid_orientations(px) > 0)) == 2
            assert (small != slow).sum() < 0.02 * (slow > 0).sum()
    assert num_both > 16


def test_nearest_samples_of_all_views_at_once_are_those_of_each() -> None:
    """Slow twin: one edge sample after the other."""
    masks, reach = stack(), 6.0
    projection = project_points(masks.px_from_world, GRID.points(ellipse(0.8, 0.5)))
    samples, covered = outline_samples(masks, GRID, projection)
    own, edge, toward = nearest_samples(masks, samples, covered, reach=reach)
    outside = masks.look_up(covered, masks.edge_stack, masks.edge_px) == 0
    pairs = {}
    for index, px in enumerate(masks.edge_px):
        here = np.flatnonzero(samples.stack == masks.edge_stack[index])
        far = np.linalg.norm(samples.px[here] - px, axis=1)
        if outside[index] and far.min() > 4:
            nearest = here[far.argmin()]
            pairs[index] = nearest, (px - samples.px[nearest]) / far.min()
            continue
        far[samples.normals[here] @ masks.edge_normals[index] < 0.5] = np.inf
        if far.min() < 2 * reach:
            pairs[index] = here[far.argmin()], masks.edge_normals[index]
    assert edge.tolist() == list(pairs)
    assert own.tolist() == [nearest for nearest, _ in pairs.values()]
    assert toward == pytest.approx(np.array([direction for _, direction in pairs.values()]))


@pytest.mark.parametrize("reach", [14.0, 6.8, 1.0])
def test_nearest_edges_of_all_samples_at_once_are_those_of_each(reach: float) -> None:
    """With edges near by, far away, in front and behind, several along one normal, and none."""
    stripes = np.where(np.arange(SIZE) % 11 > 3, NOTHING, np.int32(7))
    masks, num_found = stack([stripes] * len(CAMERAS)), 0
    for patch in (ellipse(), ellipse(0.8, 0.4)):
        samples, _ = outline_samples(masks, GRID, project_points(masks.px_from_world, GRID.points(patch)))
        found, _ = search_edges(masks, samples, masks.blurred, reach=reach, offsets=np.zeros(len(masks)))
        slow = [
            nearest_edge_reference(masks, view, px, normal=normal, reach=reach)
            for view, px, normal in zip(samples.stack, samples.px, samples.normals, strict=True)
        ]
        assert found == pytest.approx(np.array(slow), abs=1e-6, nan_ok=True)
        num_found += int(np.isfinite(found).sum())
    assert num_found > 10


def test_neighbour_behind_the_leaf_hides_nothing() -> None:
    other = NOTHING.copy()
    other[:, SIZE // 2 :] = 7
    masks = stack(others=[other] * 4)
    below, above = GRID.points(ellipse(1.2, 0.6, -0.3)), GRID.points(ellipse(1.2, 0.6, 0.3))
    own = GRID.points(ellipse())
    before = masks.others == 7
    assert (hiding_pixels(masks, own, {7: below}, margin=0.05)[before] == 0).any()
    assert (hiding_pixels(masks, own, {7: above}, margin=0.05)[before] == 7).mean() > 0.98
    assert (hiding_pixels(masks, own, {8: below}, margin=0.05) == masks.others).all()


def test_neighbour_in_front_hides_the_leaf_where_it_has_no_mask() -> None:
    """Slow twin: a pixel near the leaf is hidden where a ray meets the neighbour's disc, and does not show the leaf."""
    masks, own = stack(), GRID.points(ellipse())
    above = GRID.points(ellipse(0.5, 0.3, 0.4))
    hiding = hiding_pixels(masks, own, {8: above}, margin=0.05)
    assert set(np.unique(hiding[(masks.others == 0)])) == {0, 8}
    for index, mask in enumerate(blade_masks(EllipticBlade(), CAMERAS)):
        near = cv2.dilate(mask.astype(np.uint8), np.ones((2 * IMAGE.near_px + 1,) * 2)) > 0
        covered = draw_polygons_reference(above, index) & near
        crop = hiding[index] == 8
        y, x = np.argwhere(mask).min(0) - STACK.margin
        y, x = y + SIZE, x + SIZE
        wanted = np.pad(covered, SIZE)[y : y + crop.shape[0], x : x + crop.shape[1]] & ~masks.inside[index]
        assert (crop != wanted).mean() < 0.01


def draw_polygons_reference(points: Floats, view: int) -> np.ndarray:
    """(SIZE, SIZE) bool: pixels whose ray goes through the disc of an `ellipse`."""
    u, v = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ CAMERAS.world_from_px[view].numpy().T
    center, height = CAMERAS.centers[view].numpy(), points[0, 0, 2]
    meet = center + (height - center[2]) / rays[..., 2:] * rays
    length, width = np.abs(points[..., 0]).max(), np.abs(points[..., 1]).max()
    return (meet[..., 0] / length) ** 2 + (meet[..., 1] / width) ** 2 <= 1


def eroded_and_dilated() -> MaskStack:
    masks = zip(blade_masks(EllipticBlade(), CAMERAS), (cv2.MORPH_ERODE, cv2.MORPH_DILATE) * 2, strict=True)
    grown = [cv2.morphologyEx(mask.astype(np.uint8), change, disc(2)).astype(bool) for mask, change in masks]
    return stack_masks(grown, [NOTHING] * 4, range(4), px_from_world=matrices())


def test_a_patch_drawn_as_its_masks_are_has_no_distance() -> None:
    """Masks eroded and dilated by 2 px: drawn alike, the true patch explains them; as it is, it does not."""
    masks = eroded_and_dilated()
    alike = outline_distances(masks, GRID, ellipse(), reach=6.0, is_imaged=True, offsets=OFFSETS_PX)
    as_it_is = outline_distances(masks, GRID, ellipse(), reach=6.0, is_imaged=True)
    assert np.median(np.abs(alike.px)) < 0.3
    assert np.median(np.abs(as_it_is.px)) > 1.5


def test_masks_made_smaller_by_their_offsets_are_as_large_as_the_patch() -> None:
    """Slow twin: the masks before they were eroded and dilated by 2 px."""
    true, masks = blade_masks(EllipticBlade(), CAMERAS), eroded_and_dilated()
    covered = cover_crops(masks, project_points(masks.px_from_world, GRID.points(ellipse()))) > 0
    as_it_is = crop_ious(masks, covered)
    assert (crop_ious(masks, covered, offsets=OFFSETS_PX) > as_it_is + 0.03).all()
    assert (crop_ious(masks, covered, offsets=np.zeros(4)) == as_it_is).all()
    for index, (mask, offset) in enumerate(zip(true, OFFSETS_PX, strict=True)):
        shown = masks.depth_px[index] > offset
        assert abs(int(shown.sum()) - int(mask.sum())) < 0.05 * mask.sum()


def test_a_patch_that_no_mask_is_near_is_fitted_to_nothing() -> None:
    """Masks of several leaves under one id can make such a start."""
    far = ellipse()
    far[MIDRIB] += (100, 0, 0)
    assert outline_distances(stack(), GRID, far, reach=6.0, is_imaged=True).jacobian.shape == (0, 3 * NUM_COEFFICIENTS)
    fit = fit_patches(stack(), far[None], num_steps=FIT.num_steps)[0]
    assert np.isfinite(fit.coefficients).all()
    assert np.isnan(fit.residual_px).all()
    assert np.isnan(fit.offsets_px).all()
    assert np.isnan(fit.covariance).all()
    assert np.isfinite(fit_patches(stack(), ellipse()[None], num_steps=FIT.num_steps)[0].covariance).all()


def test_the_prior_alone_has_no_inverse_on_any_processor() -> None:
    """Moving a patch as a whole costs nothing; whether elimination stops at a pivot of 0 is a matter of rounding."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        patch = ellipse(1.0, rng.uniform(0.05, 0.5)) + rng.normal(0, rng.uniform(0, 0.3), (NUM_COEFFICIENTS, 3))
        prior, _ = patch_prior(patch, measure_patch(patch), noise=1.0)
        normal = prior.T @ prior
        assert np.isnan(invert_normal(normal)).all()
        rows = GRID.basis[:: len(GRID.basis) // 12]  # a dozen points are held in their places
        held = normal + np.kron(rows.T @ rows, np.eye(3))
        assert np.abs(invert_normal(held) @ held - np.eye(len(held))).max() < 1e-6
    assert np.isnan(invert_normal(np.zeros((3, 3)))).all()
    assert np.isnan(invert_normal(np.full((3, 3), np.inf))).all()
