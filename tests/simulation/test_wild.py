"""Wild plants: what withers stays a sound leaf with its id, and what comes besides is no leaf, or counted as one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mvseg.arrays import Floats
from mvseg.simulation.blades import BLADE_COLUMNS, Blade, place_blade
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.look import draw_look, draw_wild_look
from mvseg.simulation.wild import SOIL_CLEARANCE, hang, make_wild, roll_up
from rendered import render_view

FLAT = place_blade(Blade(length=60, width=40, outline=(0.6, 0.8)), np.array([0.0, 0, 80]), azimuth=0.7, elevation=0.2)


def flatten(plant: SimulatedPlant) -> bytes:
    meshes = [(leaf.vertices, leaf.faces) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces) for part in plant.parts]
    return b"".join(array.tobytes() for mesh in meshes for array in mesh)


def across(vertices: Floats) -> Floats:
    """(rows, columns - 1) distances between neighbours across a blade."""
    grid = vertices[1:-1].reshape(-1, BLADE_COLUMNS, 3)
    return np.asarray(np.linalg.norm(np.diff(grid, axis=1), axis=2))


@pytest.mark.parametrize("family", FAMILIES)
def test_wild_plants_are_sound(family: str) -> None:
    for seed in range(2):
        grown = grow_plant(family, 8, seed)
        wild = make_wild(grown, seed)
        assert wild.is_wild
        assert not grown.is_wild
        assert flatten(wild) == flatten(make_wild(grown, seed))
        assert [leaf.leaf_id for leaf in wild.leaves] == list(range(1, len(wild.leaves) + 1))
        assert len(wild.leaves) in (8, 10)
        for leaf in wild.leaves:
            mesh = trimesh.Trimesh(leaf.vertices, leaf.faces, process=False)
            assert mesh.area == pytest.approx(leaf.area)
            assert 0 <= leaf.dryness <= 1
        for part in wild.parts:
            assert trimesh.Trimesh(part.vertices, part.faces, process=False).area_faces.min() > 0


def test_everything_that_a_wild_plant_may_have_occurs() -> None:
    grown = grow_plant("ovate", 8, 0)
    wild = [make_wild(grown, seed) for seed in range(40)]
    fresh = {leaf.vertices.tobytes() for leaf in grown.leaves}
    withered = [sum(leaf.dryness > 0 for leaf in plant.leaves) for plant in wild]
    assert min(withered) == 0
    assert max(withered) > 2
    for plant in wild:
        assert all((leaf.dryness > 0) != (leaf.vertices.tobytes() in fresh) for leaf in plant.leaves[:8])
    assert 0 < sum(len(plant.leaves) == 10 for plant in wild) < 40
    assert len({len(plant.parts) for plant in wild}) > 3  # buds and twigs
    stem_sizes = {np.ptp(plant.parts[0].vertices[:8, 0]) for plant in wild}
    assert max(stem_sizes) > 1.3 * np.ptp(grown.parts[0].vertices[:8, 0])


def test_cotyledons_are_small_opposite_and_low() -> None:
    grown = grow_plant("leggy", 8, 1)
    pairs = [plant.leaves[8:] for plant in (make_wild(grown, seed) for seed in range(40)) if len(plant.leaves) == 10]
    assert pairs
    for first, second in pairs:
        assert max(first.length, second.length) < 30
        assert max(first.vertices[0, 2], second.vertices[0, 2]) < 0.5 * grown.stems[0][-1, 2]
        ahead = [leaf.vertices[-1, :2] - leaf.vertices[0, :2] for leaf in (first, second)]
        turn = abs(math.degrees(math.atan2(ahead[0][1], ahead[0][0]) - math.atan2(ahead[1][1], ahead[1][0])))
        assert 120 < turn < 240


@pytest.mark.parametrize("turn", [-1.5, 0.8, 3.0])
def test_rolling_up_keeps_the_midrib_and_all_widths(turn: float) -> None:
    rolled = roll_up(FLAT, turn)
    np.testing.assert_allclose(across(rolled), across(FLAT), rtol=1e-9)
    middle = slice(1 + BLADE_COLUMNS // 2, -1, BLADE_COLUMNS)
    assert np.array_equal(rolled[middle], FLAT[middle])
    assert np.ptp(rolled[:, 2]) != np.ptp(FLAT[:, 2])
    np.testing.assert_allclose(roll_up(FLAT, 0.0), FLAT, rtol=0, atol=1e-12)
    raised = rolled[1:-1].reshape(-1, BLADE_COLUMNS, 3)[..., 2]
    edges = raised[:, [0, -1]].mean(1) - raised[:, BLADE_COLUMNS // 2]
    flat = FLAT[1:-1].reshape(-1, BLADE_COLUMNS, 3)[..., 2]
    assert np.sign((edges - (flat[:, [0, -1]].mean(1) - flat[:, BLADE_COLUMNS // 2])).mean()) == np.sign(turn)


def test_a_leaf_hangs_stiffly_down_to_the_vertical_and_above_the_soil() -> None:
    hanging = hang(FLAT, 0.5)
    faces = np.linalg.norm(np.diff(hanging, axis=0), axis=1)
    np.testing.assert_allclose(faces, np.linalg.norm(np.diff(FLAT, axis=0), axis=1), rtol=1e-9)
    np.testing.assert_array_equal(hanging[0], FLAT[0])
    assert hanging[-1, 2] < FLAT[-1, 2]
    tip = hang(FLAT, 3.0)[-1] - FLAT[0]
    np.testing.assert_allclose(tip[:2], 0, atol=1e-9)
    assert tip[2] < 0
    low = FLAT - [0, 0, 60]
    assert SOIL_CLEARANCE < hang(low, 3.0)[:, 2].min() < low[:, 2].min()
    assert np.array_equal(hang(FLAT - [0, 0, 100], 3.0), FLAT - [0, 0, 100])
    upright = np.array([[0.0, 0, 5], [1, 0, 7], [0, 0, 9]])
    assert np.array_equal(hang(upright, 1.0), upright)  # there is no side to hang to


def test_dry_leaves_are_brown_and_nothing_else_changes_its_colour() -> None:
    plant = grow_plant("ovate", 2, 4)
    camera = arc_cameras(1, plant, elevations_deg=(60,), width=120, height=120)
    dry = replace(plant, leaves=(replace(plant.leaves[0], dryness=1.0), plant.leaves[1]))
    before, after = render_view(plant, camera, 0, seed=2), render_view(dry, camera, 0, seed=2)
    assert np.array_equal(before.ids, after.ids)
    inner = [before.ids == leaf_id for leaf_id in (1, 2)]
    green, brown = before.rgb[inner[0]].mean(0), after.rgb[inner[0]].mean(0)
    assert green[1] > green[0]
    assert brown[0] > brown[1] + 15
    assert brown[1] > brown[2] + 15
    np.testing.assert_allclose(after.rgb[inner[1]].mean(0), before.rgb[inner[1]].mean(0), atol=3)


def test_wild_looks_differ_and_leave_the_plain_ones_as_they_were() -> None:
    look = draw_look(np.random.default_rng(3))
    plain, backdrop = look.plain.copy(), look.backdrop.copy()
    wild = [draw_wild_look(look, np.random.default_rng(seed)) for seed in range(60)]
    assert np.array_equal(look.plain, plain)
    assert np.array_equal(look.backdrop, backdrop)
    mean = [float(w.backdrop.mean() / backdrop.mean()) for w in wild]
    assert 5 < sum(value < 0.1 for value in mean) < 30  # studios
    assert 5 < sum(float(w.backdrop.max()) > 2.5 * float(backdrop.max()) for w in wild) < 30  # windows
    assert all(w.backdrop.shape == backdrop.shape and w.backdrop.dtype == np.float32 for w in wild)
    assert all(w.plain.dtype == np.float32 and w.exposure.dtype == np.float32 for w in wild)
    for name in ("gloss", "drops", "sun_blur"):
        assert 0 < sum(getattr(w, name) != getattr(look, name) for w in wild) < 40, name
    assert 0 < sum(float(w.exposure[0]) > float(look.exposure[0]) for w in wild) < 40
