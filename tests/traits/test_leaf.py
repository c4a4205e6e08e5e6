from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from known_leaves import bent_blade, fit_coefficients, flat_leaf, folded_sheet, make_surface, move, turn_about
from mvseg.formats.text_file import format_number
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.traits.leaf import END, NEED_BASE, NEED_UP, Measurement, measure_leaf, measure_voxels, wrap_azimuth
from mvseg.traits.ontology import SURFACE_TRAITS, VOXEL_TRAITS
from mvseg.traits.up import level_frame

FRAME = level_frame((0.0, 0.0, 1.0))


def values(numbers: dict[str, Measurement]) -> dict[str, float]:
    return {name: number.value for name, number in numbers.items()}


def measure(surface: LeafSurface) -> dict[str, float]:
    return values(measure_leaf(surface, FRAME))


def test_every_trait_is_measured_with_a_deviation() -> None:
    numbers = measure_leaf(bent_blade(), FRAME)
    assert numbers.keys() == {trait.name for trait in SURFACE_TRAITS}
    assert all(number.exists and number.sd > 0 and number.method == "surface" for number in numbers.values())


@pytest.mark.parametrize("frame", [FRAME, None])
def test_deviations_are_those_of_leaves_measured_one_by_one(
    frame: np.ndarray | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    together, deviation = measure_leaf(bent_blade(), frame), LeafSurface.deviation

    def one_by_one(surface: LeafSurface, measure: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return deviation(surface, lambda leaves: np.concatenate([measure(leaf[None]) for leaf in leaves]))

    monkeypatch.setattr(LeafSurface, "deviation", one_by_one)
    alone = measure_leaf(bent_blade(), frame)
    sds = [[number.sd for number in numbers.values()] for numbers in (together, alone)]
    assert sds[0] == pytest.approx(sds[1], rel=1e-6, nan_ok=True)


def test_flat_ellipse() -> None:
    found = measure(flat_leaf(at=(3, 4, 50)))
    assert found["area"] == pytest.approx(np.pi * 20 * 10, rel=2e-3)
    assert (found["length"], found["width"]) == (pytest.approx(40), pytest.approx(20, rel=1e-3))
    assert found["length_width_ratio"] == pytest.approx(2, rel=1e-3)
    assert found["fold_angle"] == pytest.approx(180, abs=0.01)
    flat = ("inclination", "base_inclination", "tip_inclination", "curvature", "azimuth")
    assert [found[name] for name in flat] == pytest.approx([0.0] * 5, abs=0.01)
    assert (found["insertion_height"], found["insertion_angle"]) == (pytest.approx(50), pytest.approx(90))


@pytest.mark.parametrize("bend", [20.0, 60.0, 95.0])
def test_leaf_bent_over_a_cylinder(bend: float) -> None:
    """The chord over an arc has the direction of its middle."""
    found = measure(bent_blade(bend_deg=bend))
    assert found["length"] == pytest.approx(40, rel=2e-3)
    assert found["base_inclination"] == pytest.approx(-bend * END / 2, abs=0.3)
    assert found["tip_inclination"] == pytest.approx(-bend * (1 - END / 2), abs=0.3)
    assert found["curvature"] == pytest.approx(bend * (1 - END), abs=0.5)
    assert found["insertion_angle"] == pytest.approx(90 - found["base_inclination"])
    assert found["inclination"] == pytest.approx(bend / 2, abs=0.3)
    assert found["fold_angle"] == pytest.approx(180, abs=0.5)


@pytest.mark.parametrize("angle", [60.0, 90.0, 170.0])
def test_folded_leaf(angle: float) -> None:
    surface = make_surface(fit_coefficients(folded_sheet(angle), length=40, half_width=10))
    found = measure(surface)
    assert found["fold_angle"] == pytest.approx(angle, abs=0.2)
    assert found["area"] == pytest.approx(np.pi * 20 * 10, rel=3e-3)
    assert found["inclination"] == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("tilt", [-80.0, -30.0, 15.0, 70.0])
def test_rising_and_hanging_leaves(tilt: float) -> None:
    found = measure(move(flat_leaf(), turn_about(np.array([0, -1.0, 0]), tilt)))
    assert found["inclination"] == pytest.approx(abs(tilt), abs=0.01)
    assert found["base_inclination"] == pytest.approx(tilt, abs=0.01)
    assert found["tip_inclination"] == pytest.approx(tilt, abs=0.01)
    assert found["insertion_angle"] == pytest.approx(90 - tilt, abs=0.01)


def test_upper_and_lower_side_are_the_same_leaf() -> None:
    first = measure_leaf(move(bent_blade(), turn_about(np.array([1.0, 0, 0]), 20)), FRAME)
    over = measure_leaf(move(bent_blade(), np.diag([1.0, -1.0, 1.0]) @ turn_about(np.array([1.0, 0, 0]), 20)), FRAME)
    for name in ("inclination", "curvature", "fold_angle", "base_inclination", "area"):
        assert over[name].value == pytest.approx(first[name].value, abs=1e-6)
        assert over[name].sd == pytest.approx(first[name].sd, rel=1e-3)


@pytest.mark.parametrize("degrees", [37.0, 190.0, 355.0])
def test_turning_about_up_changes_the_azimuth_only(degrees: float) -> None:
    surface = move(bent_blade(), turn_about(np.array([1.0, 1.0, 0.2]), 25))
    first, second = (
        measure_leaf(move(surface, turn_about(FRAME[2], angle), shift=(90, -20, 0)), FRAME) for angle in (0, degrees)
    )
    change = (second["azimuth"].value - first["azimuth"].value - degrees) % 360
    assert min(change, 360 - change) < 1e-6
    for name, number in first.items():
        if name != "azimuth":
            assert second[name].value == pytest.approx(number.value, rel=1e-6, abs=1e-6)
        assert second[name].sd == pytest.approx(number.sd, rel=1e-3)


def test_azimuths_count_from_x_to_y_and_are_wrapped() -> None:
    wrapped = {-90: "270", -0.001: "359.999", 359.9994: "359.999", 12: "12"}
    for degrees, written in {**wrapped, **dict.fromkeys((-1e-15, 360.0, -1e-6, 359.9997, 720 - 1e-12), "0")}.items():
        assert format_number(wrap_azimuth(degrees)) == written
    assert np.isnan(wrap_azimuth(float("nan")))
    quarter = move(flat_leaf(), turn_about(FRAME[2], 90))
    assert measure(quarter)["azimuth"] == pytest.approx(90)
    sideways = level_frame((0.0, 1.0, 0.0))  # up is y: from x to -z
    assert values(measure_leaf(flat_leaf(), sideways))["azimuth"] == pytest.approx(0, abs=1e-6)
    turned = move(flat_leaf(), turn_about(np.array([0, 1.0, 0]), 90))
    assert values(measure_leaf(turned, sideways))["azimuth"] == pytest.approx(90)


def test_scaling_the_world_scales_lengths_and_areas() -> None:
    surface = move(bent_blade(), turn_about(np.array([0.3, 1.0, 0.2]), 25), shift=(10, 20, 30))
    first, second = measure_leaf(surface, FRAME), measure_leaf(move(surface, np.eye(3), scale=0.01), FRAME)
    power = {"length": 1, "area": 2, "degree": 0, "1": 0}
    for trait in SURFACE_TRAITS:
        factor = 0.01 ** power[trait.kind]
        assert second[trait.name].value == pytest.approx(factor * first[trait.name].value, rel=1e-6)
        assert second[trait.name].sd == pytest.approx(factor * first[trait.name].sd, rel=1e-3)


def test_angles_at_their_kinks_have_deviations_too() -> None:
    """A flat horizontal leaf: inclination, curvature 0, fold 180, azimuth 0; and both sides of them are as likely."""
    flat, tilted = (
        measure_leaf(move(flat_leaf(), turn_about(np.array([0, 1.0, 0]), angle)), FRAME) for angle in (0.0, 1.0)
    )
    for name in ("inclination", "curvature", "fold_angle", "azimuth", "base_inclination"):
        assert 0.1 * tilted[name].sd < flat[name].sd < 10 * tilted[name].sd


def test_what_is_unknown_empties_what_needs_it() -> None:
    for tilt, is_there in ((90, False), (-89.99, False), (85, True)):
        number = measure_leaf(move(flat_leaf(), turn_about(np.array([0, 1.0, 0]), tilt)), FRAME)["azimuth"]
        assert number.exists == is_there
        assert is_there or number.method == "not measured: the leaf points nearly straight up or down"
    known = measure_leaf(bent_blade(), FRAME)
    numbers = measure_leaf(replace(bent_blade(), is_oriented=False), FRAME)
    assert {name for name, number in numbers.items() if not number.exists} == set(NEED_BASE)
    assert all("base and tip" in numbers[name].method for name in NEED_BASE)
    assert numbers["curvature"] == known["curvature"]
    numbers = measure_leaf(bent_blade(), None)
    assert numbers.keys() == {trait.name for trait in SURFACE_TRAITS}
    assert {name for name, number in numbers.items() if not number.exists} == set(NEED_UP)
    assert all("up is unknown" in numbers[name].method for name in NEED_UP)
    assert numbers["curvature"].value == pytest.approx(measure(bent_blade())["curvature"])


def test_voxels_have_volume_and_box() -> None:
    votes = torch.zeros(4, 5, 6)
    votes[1:3, 1:2, 2:5] = 1
    origin = torch.tensor([10.0, 20, 30]).double()
    grid = VoxelGrid(origin=origin, voxel_size=2.0, votes=votes, num_views=3, threshold=0.5)
    numbers = measure_voxels(grid)
    assert numbers.keys() == {trait.name for trait in VOXEL_TRAITS}
    assert values(numbers) == {
        "volume": 48, "x_min": 12, "y_min": 22, "z_min": 34, "x_max": 16, "y_max": 24, "z_max": 40,
        "num_pieces": 1,
    }  # fmt: skip
