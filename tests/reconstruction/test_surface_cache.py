"""Surfaces from a cache are those that a fit without one finds, bit for bit, whatever was fitted before."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from blade_scene import as_regions
from known_leaves import flat_leaf
from mvseg.reconstruction import numbers
from mvseg.reconstruction.surface import fit_surfaces as fitting
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.patch_image import hiding_pixels, select_hiding
from mvseg.reconstruction.surface.surface_cache import Cache
from mvseg.verification.evidence import paint_view
from three_leaves import CAMERAS

FEW = CAMERAS[[0, 1, 3]]
LEAVES = {
    1: flat_leaf(length=1.4, half_width=0.3, at=(-0.7, -0.2, 0.3)),
    2: flat_leaf(length=1.4, half_width=0.35, at=(-0.6, 0.1, 0.0)),  # behind the first one in some views
    3: flat_leaf(length=0.5, half_width=0.15, at=(1.0, 1.1, 0.2)),
}
REGIONS, IDS = as_regions([paint_view(LEAVES, FEW, view) for view in range(len(FEW))])


def are_same(one: LeafSurface, other: LeafSurface) -> bool:
    names = ("coefficients", "covariance", "views", "residual_px", "iou", "offsets_px")
    same = (torch.allclose(getattr(one, n), getattr(other, n), 0, 0, equal_nan=True) for n in names)
    return all(same) and one.is_oriented == other.is_oriented and one.reasons == other.reasons


def fit(cached: Cache, ids: Tensor, **how: bool) -> dict[int, LeafSurface]:
    return fit_surfaces(REGIONS, ids, FEW, cache=cached, **how)


@cache
def fit_alone(ids: tuple[int, ...], **how: bool) -> dict[int, LeafSurface]:
    return fit_surfaces(REGIONS, torch.tensor(ids), FEW, **how)


@pytest.mark.parametrize("is_rough", [False, True])
def test_what_was_fitted_before_changes_no_bit(is_rough: bool) -> None:
    without_first = IDS.where(IDS != 1, -1)
    moved = IDS.clone()
    moved[(IDS == 3).nonzero()[0, 0]] = -1
    tables = [IDS, without_first, moved, IDS]
    cached: Cache = {}
    for ids in tables:
        found = fit(cached, ids, is_rough=is_rough)
        expected = fit_alone(tuple(ids.tolist()), is_rough=is_rough)
        assert list(found) == list(expected)
        assert all(are_same(found[each], expected[each]) for each in found)


def test_a_leaf_is_fitted_again_only_where_something_that_it_follows_from_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cached, asked = {}, []
    first, again = fitting._fit_first, fitting._fit_again
    monkeypatch.setattr(fitting, "_fit_first", lambda each: (asked.extend(["first"] * len(each)), first(each))[1])
    monkeypatch.setattr(fitting, "_fit_again", lambda each: (asked.extend(["again"] * len(each)), again(each))[1])
    whole = fit(cached, IDS)
    assert asked == ["first"] * 3 + ["again"] * 3
    asked.clear()
    renumbered = fit(cached, IDS + 4)
    assert all(renumbered[each + 4] is whole[each] for each in whole)
    assert asked == []
    fit_surfaces(REGIONS, IDS.where(IDS != 3, -1), FEW, same_segmenter=whole, cache=cached)
    assert asked == []  # the third leaf hides none of the others, and how masks err is known
    fit_surfaces(REGIONS, IDS.where(IDS != 1, -1), FEW, same_segmenter=whole, cache=cached)
    assert asked == ["again"]  # the masks that hid the second leaf are still there, the surface is not
    third = IDS.where(IDS == 3, -1)
    asked.clear()
    fit_surfaces(REGIONS, third, FEW[[0, 2, 1]], cache=cached)
    assert asked.count("first") == 1
    asked.clear()
    fit(cached, third)
    assert "first" not in asked
    monkeypatch.setattr(numbers, "FIT", replace(numbers.FIT, num_steps=numbers.FIT.num_steps + 1))
    fit(cached, third)
    assert asked.count("first") == 1


def test_only_leaves_that_are_near_can_hide_one() -> None:
    frames = fitting.instance_frames(REGIONS, IDS, FEW)
    points = {number: leaf.points().numpy() for number, leaf in LEAVES.items()}
    for own, near in ((1, {2}), (2, {1}), (3, set[int]())):
        masks = fitting.stack_instance(REGIONS.select(own == IDS), FEW, frames, instance=own)
        others = {number: grid for number, grid in points.items() if number != own}
        selected = select_hiding(masks, points[own], others)
        assert {*selected} == near
        whole, less = (hiding_pixels(masks, points[own], each, margin=0.05) for each in (others, selected))
        np.testing.assert_array_equal(whole, less)


def test_the_order_of_ids_does_not_matter() -> None:
    whole, other = fit_alone(tuple(IDS.tolist()), is_rough=False), fit({}, 4 - IDS)
    for each in whole:
        assert torch.equal(whole[each].coefficients, other[4 - each].coefficients)
