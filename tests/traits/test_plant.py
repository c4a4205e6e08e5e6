from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from known_leaves import bent_blade, flat_leaf, move, turn_about
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.traits.leaf import Measurement, measure_leaf
from mvseg.traits.ontology import PLANT_TRAITS
from mvseg.traits.plant import hull_volume, measure_together, measure_whole
from mvseg.traits.up import level_frame

FRAME = level_frame((0.0, 0.0, 1.0))


def some_leaves() -> dict[int, LeafSurface]:
    """Three bent leaves around a stem, at three heights, of three sizes."""
    return {
        i: move(bent_blade(length=30 + 5 * i), turn_about(FRAME[2], 120 * i), shift=(0, 0, 12 * i)) for i in (1, 2, 3)
    }


def measure(surfaces: dict[int, LeafSurface], *, num_leaves: int = 3) -> dict[str, Measurement]:
    return measure_whole(surfaces, FRAME, num_leaves=num_leaves)


def test_it_agrees_with_meshes() -> None:
    leaves = some_leaves()
    found = measure(leaves)
    whole = trimesh.util.concatenate([leaf.mesh() for leaf in leaves.values()])
    assert found.keys() == {trait.name for trait in PLANT_TRAITS}
    assert found["number_of_leaves"].value == 3
    assert found["total_leaf_area"].value == pytest.approx(whole.area, rel=1e-6)
    assert found["convex_hull_volume"].value == pytest.approx(whole.convex_hull.volume, rel=1e-4)
    assert found["height"].value == pytest.approx(np.ptp(whole.vertices[:, 2]))


def test_the_total_is_without_leaves_that_fit_badly_and_says_so() -> None:
    leaves = some_leaves()
    every, some = measure(leaves), measure_whole(leaves, FRAME, num_leaves=3, useless=[2])
    lost = measure_leaf(leaves[2], FRAME)["area"].value
    assert some["total_leaf_area"].value == pytest.approx(every["total_leaf_area"].value - lost, rel=1e-6)
    assert some["total_leaf_area"].method == f"surface (2 of 3 leaves); left out: {lost:.0f} of 2"
    assert some["height"] == every["height"]
    none = measure_whole(leaves, FRAME, num_leaves=3, useless=[*leaves])
    assert not none["total_leaf_area"].exists
    assert [*none] == [*every]


def test_numbers_and_deviations_do_not_depend_on_the_worlds_origin() -> None:
    leaves = some_leaves()
    far = {i: move(leaf, np.eye(3), shift=(1e7, -1e7, 1e7)) for i, leaf in leaves.items()}
    for name, number in measure(leaves).items():
        moved = measure(far)[name]
        assert moved.value == pytest.approx(number.value, rel=1e-6), name
        assert moved.sd == pytest.approx(number.sd, rel=1e-4, nan_ok=True), name
    for i, leaf in leaves.items():
        moved_leaf = measure_leaf(far[i], FRAME, ground=1e7)
        for name, number in measure_leaf(leaf, FRAME).items():
            assert moved_leaf[name].value == pytest.approx(number.value, rel=1e-6, abs=1e-6, nan_ok=True), name
            assert moved_leaf[name].sd == pytest.approx(number.sd, rel=1e-4, abs=1e-9, nan_ok=True), name


def test_deviations_are_those_of_independent_leaves() -> None:
    leaves = some_leaves()
    found = measure(leaves)
    sds = [measure_leaf(leaf, FRAME)["area"].sd for leaf in leaves.values()]
    assert found["total_leaf_area"].sd == pytest.approx(np.linalg.norm(sds), rel=0.01)
    for name in ("height", "convex_hull_volume"):
        assert 0 < found[name].sd < 0.2 * found[name].value


def test_deviations_are_those_of_plain_differences() -> None:
    """Slow twin: one leaf whose coefficients move along one direction, and no other.

    The leaves are uneven: on straight lines of points, any move makes the hull larger.
    """
    uneven = 0.3 * torch.from_numpy(np.random.default_rng(9).normal(size=(26, 3)))
    leaves = {i: replace(leaf, coefficients=leaf.coefficients + uneven) for i, leaf in some_leaves().items()}
    coefficients = torch.stack([leaf.coefficients for leaf in leaves.values()])
    for moved in range(3):
        step = torch.zeros_like(coefficients)
        step[moved] = torch.from_numpy(np.random.default_rng(moved).normal(size=(26, 3)))
        ahead, behind = (measure_together(coefficients + sign * 1e-5 * step, FRAME[2]) for sign in (1, -1))
        certain = {i: replace(leaf, covariance=torch.zeros(78, 78).double()) for i, leaf in leaves.items()}
        along = torch.outer(step[moved].flatten(), step[moved].flatten())
        found = measure(certain | {moved + 1: replace(certain[moved + 1], covariance=along)})
        names = ("total_leaf_area", "convex_hull_volume", "height")
        expected = ((ahead - behind).abs() / 2e-5).tolist()
        assert [found[name].sd for name in names] == pytest.approx(expected, rel=1e-4)


def test_volume_of_a_hull_is_scipys() -> None:
    points = torch.from_numpy(np.random.default_rng(1).normal(size=(120, 3)) + 5)
    assert float(hull_volume(points)) == pytest.approx(ConvexHull(points.numpy()).volume)


def test_numbers_that_cannot_be_measured_are_empty() -> None:
    flat = measure({1: flat_leaf()}, num_leaves=1)["convex_hull_volume"]
    assert (flat.exists, flat.method) == (False, "not measured: the leaves span no volume")
    no_up, no_leaves = measure_whole(some_leaves(), None, num_leaves=3), measure_whole({}, FRAME, num_leaves=2)
    assert {name for name, number in no_up.items() if not number.exists} == {"height"}
    assert no_leaves.keys() == {trait.name for trait in PLANT_TRAITS}
    assert {name for name, number in no_leaves.items() if number.exists} == {"number_of_leaves"}
