"""Leaf blades: sizes against formulas, and laws of bending, scaling and turning."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mvseg.simulation.blades import (
    BLADE_COLUMNS,
    Blade,
    Leaf,
    blade_stations,
    half_widths,
    leaf_from_blade,
    place_blade,
)

FLAT = Blade(length=70.0, width=40.0, outline=(0.6, 0.9))
BENT = dataclasses.replace(FLAT, droop=1.2, sweep=-0.3, twist=0.5, roll=0.2, fold=0.3, curl=-0.8)


def make_leaf(blade: Blade, azimuth: float = 0.4, elevation: float = 0.0) -> Leaf:
    return leaf_from_blade(1, place_blade(blade, np.array([3.0, -2.0, 50.0]), azimuth=azimuth, elevation=elevation))


def test_a_flat_blade_has_the_area_of_its_outline_and_faces_up() -> None:
    u, half = blade_stations(FLAT.rows) * FLAT.length, np.concatenate([[0], half_widths(FLAT), [0]])
    trapezoids = float(np.sum((half[1:] + half[:-1]) * np.diff(u)))
    leaf = make_leaf(FLAT)
    assert leaf.area == pytest.approx(trapezoids, rel=1e-12)
    assert leaf.length == pytest.approx(70, rel=1e-12)
    assert leaf.width == pytest.approx(40, rel=1e-12)
    leaf = make_leaf(FLAT)
    corner = leaf.vertices[leaf.faces]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert np.allclose(leaf.vertices[:, 2], 50)
    assert (normals[:, 2] > 0).all()
    assert np.allclose(normals[:, :2], 0)


@pytest.mark.parametrize("field", ["droop", "sweep", "twist", "roll", "fold", "curl"])
def test_bending_changes_neither_length_nor_width(field: str) -> None:
    leaf = make_leaf(dataclasses.replace(FLAT, **{field: 0.7}), elevation=0.5)
    assert leaf.length == pytest.approx(70, rel=1e-12)
    assert leaf.width == pytest.approx(40, rel=1e-12)


def test_sizes_scale_with_the_blade() -> None:
    one, two = make_leaf(BENT), make_leaf(dataclasses.replace(BENT, length=140.0, width=80.0))
    assert two.length == pytest.approx(2 * one.length)
    assert two.width == pytest.approx(2 * one.width)
    assert two.area == pytest.approx(4 * one.area)


def test_uv_follows_the_midrib_and_the_edge() -> None:
    leaf = make_leaf(FLAT, azimuth=0.0)
    assert np.allclose(leaf.vertices[:, 0] - 3, 70 * leaf.uv[:, 0])
    half = np.repeat(half_widths(FLAT), BLADE_COLUMNS)
    assert np.allclose(leaf.vertices[1:-1, 1] + 2, half * leaf.uv[1:-1, 1])


@pytest.mark.parametrize(("change", "num_peaks"), [({}, 1), ({"lobes": (3, 0.6)}, 3), ({"teeth": 0.4}, 22)])
def test_lobes_and_teeth_are_peaks_of_the_outline_and_keep_the_width(change: dict[str, Any], num_peaks: int) -> None:
    half = half_widths(Blade(length=70.0, width=40.0, outline=(0.5, 0.6), rows=44, **change))
    assert half.max() == pytest.approx(20)
    assert half.min() > 0
    padded = np.pad(half, 1)
    assert ((padded[1:-1] > padded[:-2]) & (padded[1:-1] > padded[2:])).sum() == num_peaks
