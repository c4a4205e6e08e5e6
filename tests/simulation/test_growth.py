"""Grown plants: sound meshes of every family, and nothing left to chance."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import SimulatedPlant, grow_plant, grow_shoots
from rendered import flatten


def share_of_crossing_leaves(plant: SimulatedPlant) -> float:
    """Share of the leaves of which more than one mesh edge in fifty passes through another leaf."""
    starts = np.cumsum([0] + [len(leaf.vertices) for leaf in plant.leaves])
    faces = np.concatenate([leaf.faces + start for leaf, start in zip(plant.leaves, starts[:-1], strict=True)])
    owner = np.repeat([leaf.leaf_id for leaf in plant.leaves], [len(leaf.faces) for leaf in plant.leaves])
    scene = EmbreeScene(robust=True)
    vertices = np.concatenate([leaf.vertices for leaf in plant.leaves]).astype(np.float32)
    TriangleMesh(scene, vertices, faces.astype(np.int32))
    crossing = 0
    for leaf in plant.leaves:
        start, end = leaf.vertices[leaf.faces[:, 0]], leaf.vertices[leaf.faces[:, 1]]
        hits = scene.run(start.astype(np.float32), (end - start).astype(np.float32), output=True)
        is_hit = (hits["primID"] >= 0) & (hits["tfar"] < 1)
        crossing += np.mean(is_hit & (owner[hits["primID"]] != leaf.leaf_id)) > 0.02
    return crossing / len(plant.leaves)


def check_meshes(plant: SimulatedPlant) -> None:
    for leaf in plant.leaves:
        assert leaf.faces.dtype == np.int32
        assert leaf.vertices.dtype == np.float64
        assert np.isfinite(leaf.vertices).all()
        assert leaf.vertices.shape[0] == leaf.uv.shape[0] == leaf.faces.max() + 1
        mesh = trimesh.Trimesh(leaf.vertices, leaf.faces, process=False)
        smallest = 1e-6 if plant.family == "fern" else 5e-4  # mm^2; a PLY's float32 blurs less; ferns are not written
        assert mesh.area_faces.min() > smallest
        assert mesh.area == pytest.approx(leaf.area)
        assert 0.04 < leaf.width / leaf.length < 1.1
    ground = min(part.vertices[:, 2].min() for part in plant.parts)
    assert min(leaf.vertices[:, 2].min() for leaf in plant.leaves) > ground
    for part in plant.parts:
        assert np.isfinite(part.vertices).all()
        assert trimesh.Trimesh(part.vertices, part.faces, process=False).area_faces.min() > 0


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_grows_sound_plants(family: str) -> None:
    """Meshes are sound, blades seldom cut through each other, and plants have the size of plants."""
    plant = grow_plant(family, 32, seed=0)
    for each in (plant, grow_plant(family, 1, seed=3)):
        assert [leaf.leaf_id for leaf in each.leaves] == list(range(1, len(each.leaves) + 1))
        check_meshes(each)
    assert len(plant.leaves) == 32
    assert share_of_crossing_leaves(plant) < 0.12
    assert 20 < max(leaf.vertices[:, 2].max() for leaf in plant.leaves) < 900


def test_leggy_stems_are_bare() -> None:
    lowest = {}
    for family in ("leggy", "ovate"):
        shoots = [grow_shoots(8, FAMILIES[family], np.random.default_rng(seed))[1] for seed in range(20)]
        lowest[family] = np.median([nodes[0].point[2] for nodes in shoots])
    assert lowest["leggy"] > 2 * lowest["ovate"]


@pytest.mark.parametrize("family", FAMILIES)
def test_the_seed_decides_everything(family: str) -> None:
    one, same, other = (flatten(grow_plant(family, 3, seed)) for seed in (5, 5, 6))
    assert one == same != other
