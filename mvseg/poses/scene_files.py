"""A posed scene on disk: photos, and the cameras as rig file and as COLMAP model."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from mvseg.formats.colmap import read_colmap
from mvseg.formats.rig import write_rig
from mvseg.poses.mapping import Structure
from mvseg.scene import Scene

IMAGES, MODEL = "images", "sparse/0"


def write_structure(structure: Structure, folder: Path) -> Scene:
    """Write the COLMAP model of a scene folder, take away the photos that have no pose, and read it as a scene."""
    for name in structure.left_out:
        (folder / IMAGES / name).unlink(missing_ok=True)
    model = folder / MODEL
    model.mkdir(parents=True, exist_ok=True)
    structure.model.write_binary(model)
    return read_colmap(model, folder)


def move_structure(structure: Structure, similarity: pycolmap.Sim3d, folder: Path) -> Scene:
    """Write and read the scene again with its world moved by a similarity."""
    structure.model.transform(similarity)
    return write_structure(structure, folder)


def write_cameras(scene: Scene, folder: Path) -> None:
    """Write the rig file of a scene folder: what the COLMAP model says, with unit and up."""
    write_rig(folder / "cameras.json", scene, [view.path.relative_to(folder).as_posix() for view in scene.views])
