"""Meshes read back by trimesh."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from known_leaves import bent_blade
from mvseg.formats.mesh import simplify_mesh, write_glb, write_ply
from mvseg.reconstruction.voxels import VoxelGrid

RED, BLUE = (250, 10, 20), (0, 30, 240)


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    """The surface of a voxel ball of radius 5 about (100, -20, 3)."""
    axis = torch.arange(24) + 0.5 - 12
    inside = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 100
    return VoxelGrid(torch.tensor([94.0, -26.0, -3.0]).double(), 0.5, inside.float(), 4, 0.5).mesh()


def test_ply_keeps_shape_place_and_colour(ball: trimesh.Trimesh, tmp_path: Path) -> None:
    write_ply(tmp_path / "leaf.ply", ball, RED, instance_id=12)
    assert (tmp_path / "leaf.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")
    back = trimesh.load_mesh(tmp_path / "leaf.ply")
    assert back.is_watertight
    assert back.is_winding_consistent
    assert back.volume == pytest.approx(4 / 3 * np.pi * 125, rel=0.03)  # positive: faces look outward
    np.testing.assert_allclose(back.bounds, [[95, -25, -2], [105, -15, 8]], atol=0.3)
    np.testing.assert_allclose(back.bounds, ball.bounds, rtol=1e-6)
    assert (back.visual.vertex_colors == [*RED, 255]).all()
    assert not ball.visual.defined  # the mesh itself stays uncoloured
    assert (back.metadata["_ply_raw"]["vertex"]["data"]["instance_id"] == 12).all()


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
        np.testing.assert_allclose(back.bounds + pose[:3, 3], meshes[name].bounds, rtol=1e-6)
        assert back.is_watertight
        material = back.visual.material
        light = [int(255 * (value / 255) ** 2.2) for value in color]  # of sRGB, nearly
        np.testing.assert_allclose(material.baseColorFactor, [*light, 255], atol=2)
        assert (material.doubleSided, material.metallicFactor) == (True, 0)


def test_meshes_stay_whole_far_from_the_origin(tmp_path: Path) -> None:
    """1e7 away, with 32 bits, a leaf of this size would be a few points."""
    leaf, far = bent_blade(length=0.03).mesh(), np.array([1e7, -1e7, 800.0])
    moved = trimesh.Trimesh(leaf.vertices + far, leaf.faces, process=False)
    write_ply(tmp_path / "leaf.ply", moved, RED, instance_id=1)
    back = trimesh.load_mesh(tmp_path / "leaf.ply")
    np.testing.assert_allclose(back.vertices - far, leaf.vertices, atol=1e-8)
    turn = np.diag([2.0, 2, 2, 1])
    write_glb(tmp_path / "scene.glb", {"leaf_001": moved}, {"leaf_001": RED}, matrix=turn)
    scene = trimesh.load_scene(tmp_path / "scene.glb")
    pose, geometry = scene.graph["leaf_001"]
    assert scene.geometry[geometry].area == pytest.approx(leaf.area, rel=1e-6)
    np.testing.assert_allclose(trimesh.transform_points(scene.geometry[geometry].vertices, pose) / 2 - far,
                               leaf.vertices, atol=1e-8)  # fmt: skip
    few, few_moved = simplify_mesh(leaf, 300), simplify_mesh(moved, 300)
    assert few_moved.area == pytest.approx(few.area, rel=1e-3)


def test_glb_places_the_world_and_says_what_was_measured(ball: trimesh.Trimesh, tmp_path: Path) -> None:
    """Vertices are about the middle of all; the node above turns z up to y and millimetres to metres."""
    matrix = np.array([[0.001, 0, 0, 0], [0, 0, 0.001, 0], [0, -0.001, 0, 0], [0, 0, 0, 1]])
    path, said = tmp_path / "scene.glb", {"leaf": 1, "traits": {"area": 12.5}}
    more = {"about": {"unit": "mm"}, "extras": {"leaf_001": said}}
    write_glb(path, {"leaf_001": ball}, {"leaf_001": RED}, matrix=matrix, **more)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    header = json.loads(content[20 : 20 + length])
    root = header["nodes"][header["scenes"][0]["nodes"][0]]
    assert (root["extras"], len(header["scenes"][0]["nodes"])) == ({"unit": "mm"}, 1)
    moved, middle = np.eye(4), ball.bounds.mean(0)
    moved[:3, 3] = middle
    np.testing.assert_allclose(np.reshape(root["matrix"], (4, 4)).T, matrix @ moved)  # glTF's are column-major
    (leaf,) = (header["nodes"][child] for child in root["children"])
    assert (leaf["name"], leaf["extras"]) == ("leaf_001", said)
    (primitive,) = header["meshes"][leaf["mesh"]]["primitives"]
    assert primitive["attributes"].keys() == {"POSITION", "NORMAL"}
    bounds = header["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose([bounds["min"], bounds["max"]] + middle, ball.bounds, rtol=1e-6)
    placed = trimesh.load_scene(path)
    np.testing.assert_allclose(placed.bounds, [[0.095, -0.002, 0.015], [0.105, 0.008, 0.025]], atol=3e-4)


def test_an_open_surface_stays_open_and_has_its_normals(tmp_path: Path) -> None:
    leaf = bent_blade()
    write_ply(tmp_path / "leaf.ply", leaf.mesh(), RED, instance_id=1)
    write_glb(tmp_path / "scene.glb", {"leaf_001": leaf.mesh()}, {"leaf_001": RED})
    assert b"property float nx" in (tmp_path / "leaf.ply").read_bytes()
    (shown,) = trimesh.load_scene(tmp_path / "scene.glb").geometry.values()
    for back in (shown, trimesh.load_mesh(tmp_path / "leaf.ply")):
        assert not back.is_watertight
        assert back.area == pytest.approx(leaf.area, rel=1e-5)
        np.testing.assert_allclose(np.linalg.norm(back.vertex_normals, axis=1), 1, atol=1e-4)
        assert (back.vertex_normals @ leaf.mesh().face_normals.mean(0) > 0).all()


def test_a_simpler_mesh_has_the_shape(ball: trimesh.Trimesh) -> None:
    simple = simplify_mesh(ball, 200)
    assert 150 < len(simple.faces) <= 200 < len(ball.faces)
    assert simple.volume == pytest.approx(ball.volume, rel=0.04)
    np.testing.assert_allclose(np.linalg.norm(simple.vertex_normals, axis=1), 1, atol=1e-6)
    assert simplify_mesh(ball, len(ball.faces)) is ball


def test_all_normals_in_a_glb_are_unit_vectors(tmp_path: Path) -> None:
    """Two sides that touch have none of their own, which is an error in glTF."""
    sides = trimesh.Trimesh(np.eye(3), [[0, 1, 2], [0, 2, 1]], process=False)
    write_glb(tmp_path / "scene.glb", {"leaf_001": sides}, {"leaf_001": RED})
    (shown,) = trimesh.load_scene(tmp_path / "scene.glb", process=False).geometry.values()
    np.testing.assert_allclose(np.linalg.norm(shown.vertex_normals, axis=1), 1, atol=1e-6)
