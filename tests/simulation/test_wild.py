"""Wild plants: what withers stays a sound leaf with its id, and what comes besides is no leaf, or counted as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.wild import make_wild
from rendered import flatten, render_view


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
