"""Meshes out: PLY per instance, one GLB with a node per instance, through trimesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import trimesh


def write_ply(path: Path, mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> None:
    """Write one mesh as binary PLY, in world coordinates, every vertex in the RGB colour (0 to 255)."""
    path.write_bytes(trimesh.exchange.ply.export_ply(_colored(mesh, color)))


def write_glb(path: Path, meshes: Mapping[str, trimesh.Trimesh], colors: Mapping[str, tuple[int, int, int]]) -> None:
    """Write meshes as one binary glTF, a node per name, in world coordinates (axes and unit stay the scene's)."""
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        scene.add_geometry(_colored(mesh, colors[name]), node_name=name, geom_name=name)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene))


def _colored(mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> trimesh.Trimesh:
    visual = trimesh.visual.ColorVisuals(vertex_colors=[[*color, 255]] * len(mesh.vertices))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
