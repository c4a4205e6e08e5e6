"""The files of a plant in 3D: a mesh for every leaf, the scene, the table of traits.

A separate file, because a run that only matches does not need the libraries that it imports.
"""

from __future__ import annotations

from pathlib import Path

from mvseg.formats.mesh import simplify_mesh, write_glb, write_ply
from mvseg.reconstruction.shapes import best_shape
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.gltf import describe_world, gltf_from_world, leaf_extras
from mvseg.results.overlay import instance_color
from mvseg.results.result import Result
from mvseg.traits.table import write_long, write_wide

MAX_FACES = 4000  # triangles of a leaf in scene.glb; its own file has all of them


def write_plant(result: Result, folder: Path) -> None:
    """Write leaves/*.ply, scene.glb and, where traits were measured, traits.csv and traits_wide.csv."""
    _write_shapes(result, folder)
    if result.traits is not None:
        write_long(folder / "traits.csv", result.traits)
        write_wide(folder / "traits_wide.csv", result.traits)


def _write_shapes(result: Result, folder: Path) -> None:
    """leaves/*.ply and scene.glb: credible surfaces, for other instances voxels. The voxels of a leaf that has both get
    a file of their own."""
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
    about, extras = describe_world(result.scene), leaf_extras(result.traits)
    write_glb(folder / "scene.glb", meshes, colors, matrix=gltf_from_world(result.scene), about=about, extras=extras)
