from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from blade_scene import SIZE
from known_leaves import flat_leaf
from mvseg.reconstruction.stem.fit_tube import apparent_widths, fit_tube, see_tube, tube_distances
from mvseg.reconstruction.stem.slenderness import stem_chances
from mvseg.reconstruction.stem.tube import Tube, axis_slopes, fit_axis, sweep_circle
from mvseg.reconstruction.surface.leaf_patch import spline_basis
from mvseg.reconstruction.surface.mask_stack import MaskStack
from reference import nearest_edge_reference
from tube_scene import BENT, CAMERAS, STRAIGHT, T, stack, tube_masks
from turned_worlds import tell_otherwise

SHAPES = {
    "cylinder": (STRAIGHT, 0.06 + 0 * T),
    "cone": (STRAIGHT, 0.1 - 0.07 * T),
    "bent": (BENT, 0.06 + 0 * T),
    "thin": (BENT, 0.02 + 0 * T),
}


def length_of(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def miss(tube: Tube, points: np.ndarray) -> float:
    """How far the axis is from the true one, at most."""
    dense = np.stack([np.interp(np.linspace(0, 1, 2000), T, axis) for axis in points.T], 1)
    return float(cKDTree(dense).query(tube.points())[0].max())


@pytest.mark.parametrize("shape", SHAPES)
def test_a_tube_of_known_shape_is_found_from_its_masks(shape: str) -> None:
    points, radius = SHAPES[shape]
    tube = fit_tube(stack(tube_masks(points, radius)))
    assert tube.exists
    assert tube.length == pytest.approx(length_of(points), rel=0.012)
    assert tube.diameter == pytest.approx(2 * np.median(radius), rel=0.05)
    assert miss(tube, points) < 0.02
    assert np.median(tube.iou) > 0.82
    ends = np.sort(tube.radius()[[0, -1]])
    assert ends == pytest.approx(np.sort(radius[[0, -1]]), abs=0.011)


def test_it_goes_where_its_masks_go_however_the_world_is_told() -> None:
    masks = tube_masks(*SHAPES["bent"])
    first = fit_tube(stack(masks))
    for name, (told, cameras) in tell_otherwise(masks, CAMERAS).items():
        tube = fit_tube(stack(told, cameras))
        assert tube.length == pytest.approx(first.length, rel=3e-3), name
        assert tube.diameter == pytest.approx(first.diameter, rel=0.02), name


def test_order_of_views_and_scale_of_the_world_do_not_matter() -> None:
    masks = tube_masks(*SHAPES["bent"])
    first = fit_tube(stack(masks))
    order = [3, 7, 0, 9, 1, 8, 2, 6, 4, 5]
    turned = fit_tube(stack([masks[view] for view in order], CAMERAS[order]))
    scaled = fit_tube(stack(masks, CAMERAS.scale(250.0)))
    assert turned.length == pytest.approx(first.length, rel=2e-3)
    assert scaled.length / 250 == pytest.approx(first.length, rel=2e-3)
    assert scaled.diameter / 250 == pytest.approx(first.diameter, rel=5e-3)


def test_a_start_saves_the_search_and_an_end_may_be_any() -> None:
    masks = stack(tube_masks(*SHAPES["bent"]))
    first = fit_tube(masks)
    started = fit_tube(masks, BENT[::-1] + 0.03)
    assert started.length == pytest.approx(first.length, rel=5e-3)
    back = started.reverse()
    assert np.linalg.norm(back.points()[0] - BENT[0]) < 0.03


def test_masks_that_show_a_part_and_leaves_in_front_do_not_shorten_it() -> None:
    points, radius = SHAPES["bent"]
    masks = tube_masks(points, radius)
    others = [np.zeros((SIZE, SIZE), np.int32) for _ in masks]
    for view in (0, 3, 6):  # a leaf hides the upper half
        half = int(np.median(np.nonzero(masks[view])[0]))
        others[view][:half] = 7 * masks[view][:half]
        masks[view][:half] = False
    for view in (1, 5):  # the segmenter saw the lower half only
        masks[view][: int(np.median(np.nonzero(masks[view])[0]))] = False
    tube = fit_tube(stack(masks, others=others))
    assert tube.length == pytest.approx(length_of(points), rel=0.03)
    assert miss(tube, points) < 0.03
    assert tube.diameter == pytest.approx(0.12, rel=0.06)


def test_one_view_and_masks_without_a_common_point_have_none() -> None:
    masks = stack(tube_masks(*SHAPES["bent"]))
    one = fit_tube(masks.select(np.arange(len(masks)) == 0))
    assert not one.exists
    assert len(one.mesh().faces) == 0
    away = np.zeros((SIZE, SIZE), bool)
    away[:3, :3] = True
    apart = fit_tube(stack([away, np.rot90(away, 2).copy()], CAMERAS[[0, 1]]))
    assert not apart.exists


def test_distances_are_those_along_each_normal() -> None:
    """Slow twin: a search pixel by pixel along the normals of the outline."""
    masks: MaskStack = stack(tube_masks(*SHAPES["bent"]))
    axis, radii = fit_axis(BENT + 0.01), np.full(3, 0.05)
    found = tube_distances(masks, axis, radii, reach=6.0)
    u = np.linspace(0, 1, 24)
    ahead = axis_slopes(u) @ axis
    seen = see_tube(masks.px_from_world, spline_basis(u, 6) @ axis, ahead / np.linalg.norm(ahead, axis=1)[:, None])
    expected = []
    for view in range(len(masks)):
        for side in (-1, 1):
            for place in range(1, 23):
                normal = side * seen.normals[view, place]
                px = seen.px[view, place] + 0.05 * seen.per_radius[view, place] * normal
                expected.append(nearest_edge_reference(masks, view, px, normal=normal, reach=6.0))
    slow = np.array(expected)
    assert found.px[found.is_side] == pytest.approx(slow[np.isfinite(slow)], abs=0.08)


def test_jacobian_is_the_change_of_the_outline() -> None:
    masks = stack(tube_masks(*SHAPES["bent"]))
    axis, radii = fit_axis(BENT), np.full(3, 0.06)
    before = tube_distances(masks, axis, radii, reach=6.0)
    wider = tube_distances(masks, axis, radii + 0.005, reach=6.0)
    moved = (before.px - wider.px)[before.is_side]
    told = (before.jacobian[:, -3:].sum(1) * 0.005)[before.is_side]
    assert np.median(moved / told) == pytest.approx(1, abs=0.1)


def test_widths_are_not_measured_where_another_instance_is() -> None:
    masks = tube_masks(STRAIGHT, 0.06 + 0 * T)
    others = [np.zeros((SIZE, SIZE), np.int32) for _ in masks]
    others[0][:, int(np.median(np.nonzero(masks[0])[1])) + 4 :] = 5
    widths, px = apparent_widths(stack(masks, others=others), fit_axis(STRAIGHT))
    assert np.isnan(widths[0]).all()
    assert np.nanmedian(widths[1:]) == pytest.approx(0.12, rel=0.06)
    assert (px[np.isfinite(px)] > 3).all()


def test_mesh_is_closed_and_as_large_as_the_tube() -> None:
    mesh = sweep_circle(STRAIGHT, 0.06 + 0 * T)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * 0.06**2 * 2, rel=0.06)
    assert fit_tube(stack(tube_masks(*SHAPES["bent"]))).mesh().is_watertight


def test_stems_are_slender_for_their_plant() -> None:
    """In any world; where all leaves are as slender, there are none."""
    leaves = {number: flat_leaf(length=40.0, half_width=width) for number, width in enumerate((10, 9, 8, 2), start=1)}
    chances = stem_chances(leaves)
    assert chances[4] > 0.99
    assert max(chances[number] for number in (1, 2, 3)) < 1e-6
    small = {
        number: flat_leaf(length=4.0, half_width=width) for number, width in enumerate((1, 0.9, 0.8, 0.2), start=1)
    }
    assert stem_chances(small) == pytest.approx(chances, abs=1e-6)
    assert max(stem_chances({number: flat_leaf(length=40.0, half_width=2.0) for number in (1, 2)}).values()) < 1e-6
    assert stem_chances({}) == {}
