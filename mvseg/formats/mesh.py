"""Meshes out: PLY per instance, one GLB with a node per instance, through trimesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import trimesh


def write_ply(path: Path, mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> None:
    """Write one mesh as binary PLY, in world coordinates, every vertex in the RGB colour (0 to 255)."""
    path.write_bytes(trimesh.exchange.ply.export_ply(_colored(mesh, color)))


def write_glb(path: Path, meshes: Mapping[str, trimesh.Trimesh], colors: Mapping[str, tuple[int, int, int]]) -> None:
    """Write meshes as one binary glTF, in world coordinates (axes and unit stay the scene's).

    Each name gets a node and a material of its own, which is seen from both sides: a leaf may be an open surface.
    """
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[*colors[name], 255], metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
        )
        visual = trimesh.visual.TextureVisuals(material=material)
        painted = trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
        scene.add_geometry(painted, node_name=name, geom_name=name)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene))


def _colored(mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> trimesh.Trimesh:
    visual = trimesh.visual.ColorVisuals(vertex_colors=[[*color, 255]] * len(mesh.vertices))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
