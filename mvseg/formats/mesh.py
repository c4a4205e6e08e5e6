"""Writes meshes: a PLY per instance, and through trimesh one GLB with a node per instance.

Wherever the world's origin is, meshes stay whole: PLY has numbers of 64 bits (trimesh writes 32), and GLB, which knows
32 bits only, has vertices about the middle of the plant, and a node that moves them there.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = "plant"  # the node above all others in a GLB
# What PLY says of a vertex: name, kind in NumPy and in PLY.
VERTEX = (
    *((axis, "<f8", "double") for axis in "xyz"), *((f"n{axis}", "<f4", "float") for axis in "xyz"),
    *((color, "u1", "uchar") for color in ("red", "green", "blue", "alpha")), ("instance_id", "<i4", "int"),
)  # fmt: skip


def simplify_mesh(mesh: trimesh.Trimesh, max_faces: int) -> trimesh.Trimesh:
    """A closed mesh with at most `max_faces` triangles, by quadric decimation, which may damage the boundary of an open
    one; smaller meshes are returned as they are."""
    if len(mesh.faces) <= max_faces:
        return mesh
    middle = mesh.bounds.mean(0)  # the library computes with 32 bits
    near = trimesh.Trimesh(mesh.vertices - middle, mesh.faces, process=False)
    near = near.simplify_quadric_decimation(face_count=max_faces)
    return trimesh.Trimesh(near.vertices + middle, near.faces, process=False)


def write_ply(path: Path, mesh: trimesh.Trimesh, color: tuple[int, int, int], *, instance_id: int) -> None:
    """Write one mesh as binary PLY with normals, in world coordinates; every vertex has the RGB colour (0 to 255), and
    the id as its property `instance_id`."""
    vertices = np.zeros(len(mesh.vertices), [(name, kind) for name, kind, _ in VERTEX])
    columns = (*mesh.vertices.T, *mesh.vertex_normals.T, *color, 255, instance_id)
    for (name, *_), column in zip(VERTEX, columns, strict=True):
        vertices[name] = column
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {kind} {name}" for name, _, kind in VERTEX]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(lines).encode("ascii") + vertices.tobytes() + faces.tobytes())


def write_glb(
    path: Path,
    meshes: Mapping[str, trimesh.Trimesh],
    colors: Mapping[str, tuple[int, int, int]],
    *,
    matrix: NDArray[np.float64] | None = None,
    about: Mapping[str, Any] | None = None,
    extras: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write meshes as one binary glTF, with normals, below a node that transforms them.

    Vertices are about the middle of all meshes; the node takes them from there to glTF's world. Each name gets a node
    and a double-sided material of its own: a leaf may be an open surface.

    Args:
        colors: {name: RGB, 0 to 255}, sRGB; the file has them linear, as glTF requires.
        matrix: (4, 4) gltf_from_world; glTF is in metres, +y is up. None: the identity.
        about: the `extras` of that node.
        extras: {name: the `extras` of its node}.
    """
    scene = trimesh.Scene()
    ends = np.array([mesh.bounds for mesh in meshes.values() if len(mesh.vertices)]).reshape(-1, 3)
    middle = (ends.min(0) + ends.max(0)) / 2 if len(ends) else np.zeros(3)
    root = np.eye(4) if matrix is None else matrix.copy()
    root[:3, 3] += root[:3, :3] @ middle
    scene.graph.update(frame_from=scene.graph.base_frame, frame_to=ROOT, matrix=root, metadata=dict(about or {}))
    for name, mesh in meshes.items():
        share = np.array(colors[name]) / 255
        light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        linear = [round(float(255 * value)) for value in light]  # trimesh keeps no fractions
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[*linear, 255], metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
        )
        visual = trimesh.visual.TextureVisuals(material=material)
        normals = np.array(mesh.vertex_normals)  # of length 0 where two sides touch: glTF allows unit vectors only
        normals[np.abs(np.linalg.norm(normals, axis=1) - 1) > 1e-3] = (0, 0, 1)
        near = mesh.vertices - middle
        painted = trimesh.Trimesh(near, mesh.faces, vertex_normals=normals, visual=visual, process=False)
        said = dict((extras or {}).get(name, {}))
        scene.add_geometry(painted, node_name=name, geom_name=name, parent_node_name=ROOT, metadata=said)
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))
