"""Writes meshes through trimesh: a PLY per instance, and one GLB with a node per instance."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = "plant"  # the node above all others in a GLB


def simplify_mesh(mesh: trimesh.Trimesh, max_faces: int) -> trimesh.Trimesh:
    """A closed mesh with at most `max_faces` triangles, by quadric decimation, which may damage the boundary of an open
    one; smaller meshes are returned as they are."""
    return mesh if len(mesh.faces) <= max_faces else mesh.simplify_quadric_decimation(face_count=max_faces)


def write_ply(path: Path, mesh: trimesh.Trimesh, color: tuple[int, int, int], *, instance_id: int) -> None:
    """Write one mesh as binary PLY with normals, in world coordinates.

    Every vertex has the RGB colour (0 to 255), and the id as its property `instance_id`.
    """
    colors = np.tile(np.array([*color, 255], np.uint8), (len(mesh.vertices), 1))
    colored = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    colored.vertex_attributes["instance_id"] = np.full(len(mesh.vertices), instance_id, np.int32)
    path.write_bytes(trimesh.exchange.ply.export_ply(colored, vertex_normal=True))


def write_glb(
    path: Path,
    meshes: Mapping[str, trimesh.Trimesh],
    colors: Mapping[str, tuple[int, int, int]],
    *,
    matrix: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
    extras: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write meshes as one binary glTF, with normals, in world coordinates below a node that transforms them.

    Each name gets a node and a double-sided material of its own: a leaf may be an open surface.

    Args:
        path: the file.
        meshes: {name: mesh}.
        colors: {name: RGB, 0 to 255}, sRGB; the file has them linear, as glTF requires.
        matrix: (4, 4) gltf_from_world, of the node above all others; glTF is in metres, +y is up. None: the identity.
        about: the `extras` of that node.
        extras: {name: the `extras` of its node}.
    """
    scene = trimesh.Scene()
    root = np.eye(4) if matrix is None else matrix
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to=ROOT, matrix=root, metadata=dict(about or {}))
    for name, mesh in meshes.items():
        material = trimesh.visual.material.PBRMaterial(
            name=name,
            baseColorFactor=[*_linear(colors[name]), 255],
            metallicFactor=0.0,
            roughnessFactor=0.8,
            doubleSided=True,
        )
        visual = trimesh.visual.TextureVisuals(material=material)
        normals = _unit_normals(mesh)
        painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, visual=visual, process=False)
        said = dict((extras or {}).get(name, {}))
        scene.add_geometry(painted, node_name=name, geom_name=name, parent_node_name=ROOT, metadata=said)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def _unit_normals(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """(P, 3) normals of the vertices; those of a place without any (two sides that touch) point along +z, since glTF
    allows unit vectors only."""
    normals = np.array(mesh.vertex_normals)
    has_none = np.abs(np.linalg.norm(normals, axis=1) - 1) > 1e-3
    normals[has_none] = (0, 0, 1)
    return normals


def _linear(color: tuple[int, int, int]) -> list[int]:
    """Linear light of an sRGB colour, 0 to 255 (trimesh keeps no fractions)."""
    share = np.array(color) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return [round(float(255 * value)) for value in light]
