"""The files of a plant in 3D: a mesh for every leaf, the scene, the table of traits.

A separate file, because a run that only matches does not need the libraries that it imports. glTF is in metres, and +y
is up; a scene whose cameras do not state unit or up keeps its own.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvseg.formats.mesh import simplify_mesh, write_glb, write_ply
from mvseg.reconstruction.shapes import best_shape
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.overlay import instance_color
from mvseg.results.plant_graph import leaf_extras, plant_graph
from mvseg.results.result import Result
from mvseg.results.shapes_file import SURFACES_FILE, VOXELS_FILE, write_surfaces, write_voxels
from mvseg.results.stem_shapes import parts_of
from mvseg.scene import Scene
from mvseg.system.atomic import write_text_whole
from mvseg.traits.table import write_long, write_nodes, write_wide
from mvseg.traits.up import level_frame

NODES_FILE, GRAPH_FILE = "nodes.csv", "plant.json"
MAX_FACES = 4000  # limit: max. triangles of a leaf in scene.glb; its own file has all of them
METRES = {
    "m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6,
    **{f"{prefix}met{end}": power for prefix, power in (("", 1.0), ("centi", 1e-2), ("milli", 1e-3))
       for end in ("re", "res", "er", "ers")},
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
}  # fmt: skip


def write_plant(result: Result, folder: Path) -> None:
    """Write surfaces.npz, voxels.npz, leaves/*.ply, scene.glb and, where traits were measured, traits.csv,
    traits_wide.csv, plant.json and, where a stem was found, nodes.csv.

    Meshes are of credible surfaces, or else of voxels. If a leaf has both, its voxels get their own file.
    """
    if result.surfaces is not None:
        write_surfaces(folder / SURFACES_FILE, result.surfaces)
    if result.voxels:
        write_voxels(folder / VOXELS_FILE, result.voxels)
    (folder / "leaves").mkdir()
    meshes, colors = {}, {}
    for instance in range(1, result.matching.num_instances + 1):
        shape = best_shape(instance, result.surfaces, result.voxels)
        name, color = f"leaf_{instance:03d}", instance_color(instance)
        if shape is not None and len((mesh := shape.mesh()).faces):
            meshes[name], colors[name] = simplify_mesh(mesh, MAX_FACES), color
            write_ply(folder / "leaves" / f"{name}.ply", mesh, color, instance_id=instance)
        if isinstance(shape, LeafSurface) and result.voxels and instance in result.voxels:
            voxels = result.voxels[instance].mesh()
            write_ply(folder / "leaves" / f"{name}_voxels.ply", voxels, color, instance_id=instance)
    for part in parts_of(result):
        meshes[part.name], colors[part.name] = part.mesh(), part.color
    leaves = () if result.traits is None else result.traits.leaves
    about, extras = describe_world(result.scene), {f"leaf_{leaf.leaf:03d}": leaf_extras(leaf) for leaf in leaves}
    write_glb(folder / "scene.glb", meshes, colors, matrix=gltf_from_world(result.scene), about=about, extras=extras)
    if result.traits is not None:
        write_long(folder / "traits.csv", result.traits)
        write_wide(folder / "traits_wide.csv", result.traits)
        write_text_whole(folder / GRAPH_FILE, json.dumps(plant_graph(result.traits), indent=1, allow_nan=False) + "\n")
        if result.traits.stems:
            write_nodes(folder / NODES_FILE, result.traits)


def gltf_from_world(scene: Scene) -> NDArray[np.float64]:
    """(4, 4) that rotates up to +y and east to +x (`level_frame`) if up is known, and scales to metres if the unit is
    known."""
    matrix = np.eye(4)
    if scene.up is not None:
        east, north, up = level_frame(scene.up)
        matrix[:3, :3] = np.stack([east, up, -north])
    matrix[:3, :3] *= METRES.get(scene.unit.strip().lower(), 1.0)
    return matrix


def describe_world(scene: Scene) -> dict[str, Any]:
    """The extras of the node above all leaves: the unit and the up of the meshes' own coordinates, None where unknown,
    and whether the node brings them to glTF's."""
    up = None if scene.up is None else list(scene.up)
    placed = {"is_in_metres": scene.unit.strip().lower() in METRES, "is_y_up": up is not None}
    return {"plant": scene.name, "unit": scene.unit or None, "up": up, **placed}
