"""Meshes read back by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from mvseg.formats.mesh import write_glb, write_ply
from mvseg.reconstruction.voxels import VoxelGrid

RED, BLUE = (250, 10, 20), (0, 30, 240)


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    """The surface of a voxel ball of radius 5 about (100, -20, 3)."""
    axis = torch.arange(24) + 0.5 - 12
    inside = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 100
    return VoxelGrid(torch.tensor([94.0, -26.0, -3.0]).double(), 0.5, inside.float(), 4, 0.5).mesh()


def test_ply_keeps_shape_place_and_colour(ball: trimesh.Trimesh, tmp_path: Path) -> None:
    write_ply(tmp_path / "leaf.ply", ball, RED)
    assert (tmp_path / "leaf.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")
    back = trimesh.load_mesh(tmp_path / "leaf.ply")
    assert back.is_watertight
    assert back.is_winding_consistent
    assert back.volume == pytest.approx(4 / 3 * np.pi * 125, rel=0.03)  # positive: faces look outward
    np.testing.assert_allclose(back.bounds, [[95, -25, -2], [105, -15, 8]], atol=0.3)
    np.testing.assert_allclose(back.bounds, ball.bounds, rtol=1e-6)
    assert (back.visual.vertex_colors == [*RED, 255]).all()


def test_glb_has_a_node_per_mesh(ball: trimesh.Trimesh, tmp_path: Path) -> None:
    moved = ball.copy()
    moved.apply_translation([0, 0, 50])
    meshes = {"leaf_001": ball, "leaf_012": moved}
    write_glb(tmp_path / "scene.glb", meshes, {"leaf_001": RED, "leaf_012": BLUE})
    scene = trimesh.load_scene(tmp_path / "scene.glb")
    assert set(scene.graph.nodes_geometry) == {"leaf_001", "leaf_012"}
    for name, color in (("leaf_001", RED), ("leaf_012", BLUE)):
        pose, geometry = scene.graph[name]
        back = scene.geometry[geometry]
        np.testing.assert_array_equal(pose, np.eye(4))
        np.testing.assert_allclose(back.bounds, meshes[name].bounds, rtol=1e-6)
        assert back.is_watertight
        material = back.visual.material
        assert material.baseColorFactor.tolist() == [*color, 255]
        assert (material.doubleSided, material.metallicFactor) == (True, 0)


def test_the_mesh_itself_stays_uncoloured(ball: trimesh.Trimesh, tmp_path: Path) -> None:
    write_ply(tmp_path / "leaf.ply", ball, RED)
    assert not ball.visual.defined


def test_glb_without_meshes_is_a_valid_file(tmp_path: Path) -> None:
    write_glb(tmp_path / "scene.glb", {}, {})
    assert (tmp_path / "scene.glb").read_bytes()[:4] == b"glTF"
    assert not trimesh.load_scene(tmp_path / "scene.glb").geometry
