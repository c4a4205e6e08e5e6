"""Meshes out: PLY per instance, one GLB with a node per instance, through trimesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = "plant"  # the node above all others in a GLB


def write_ply(path: Path, mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> None:
    """Write one mesh as binary PLY with normals, in world coordinates, every vertex in the RGB colour (0 to 255)."""
    path.write_bytes(trimesh.exchange.ply.export_ply(_colored(mesh, color), vertex_normal=True))


def write_glb(
    path: Path,
    meshes: Mapping[str, trimesh.Trimesh],
    colors: Mapping[str, tuple[int, int, int]],
    *,
    matrix: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
    extras: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write meshes as one binary glTF, with normals. Their coordinates stay the world's: a node above them places them.

    Each name gets a node and a material of its own, which is seen from both sides: a leaf may be an open surface.

    Args:
        path: the file.
        meshes: {name: mesh}.
        colors: {name: RGB, 0 to 255}.
        matrix: (4, 4) gltf_from_world, of the node above all others; glTF is in metres, +y is up. None: the identity.
        about: what that node says in its `extras`.
        extras: {name: what its node says in its `extras`}.
    """
    scene = trimesh.Scene()
    root = np.eye(4) if matrix is None else matrix
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to=ROOT, matrix=root, metadata=dict(about or {}))
    for name, mesh in meshes.items():
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[*colors[name], 255], metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
        )
        visual = trimesh.visual.TextureVisuals(material=material)
        painted = trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
        said = dict((extras or {}).get(name, {}))
        scene.add_geometry(painted, node_name=name, geom_name=name, parent_node_name=ROOT, metadata=said)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def _colored(mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> trimesh.Trimesh:
    visual = trimesh.visual.ColorVisuals(vertex_colors=[[*color, 255]] * len(mesh.vertices))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
