"""The simulated scenes: test plants of every number of leaves, photographed by every number of cameras, and cached."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_scene
from mvseg.scene import Scene
from mvseg.simulation import dataset
from mvseg.simulation.dataset import Preset, SceneSpec, list_specs, scene_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene
from mvseg.system.atomic import write_text_whole

SEED = 7  # the test plants of seed 0 were used in development
Record = dict[str, Any]

PAPER = replace(dataset.PRESETS["paper-eval"], plants=(("test", 3),))
PRESETS = {
    "paper": PAPER,
    "small": replace(PAPER, plants=(("test", 1),), leaves=(4, 8), views=(3, 5), size=(240, 240)),
}


@dataclass(frozen=True, eq=False)
class Cell:
    """One plant and one set of cameras, or a real scene in the same layout.

    Attributes:
        name: unique among the cells.
        axes: what the tables group by: "leaves", "views", "family" of a simulated plant; empty for a real scene.
        folder: of the scene: cameras, images/, masks/, truth/.
        scene: cameras and views.
        truth: V arrays (H, W) uint16, true leaf ids, 0 = no leaf, 65535 = ignore.
    """

    name: str
    axes: Record
    folder: Path
    scene: Scene
    truth: tuple[np.ndarray, ...]


def list_cells(preset: Preset) -> list[SceneSpec]:
    """The scenes of a preset, the cheapest first."""
    return sorted(list_specs(preset, SEED), key=lambda spec: (spec.num_leaves * spec.num_views, spec.folder))


def open_cell(spec: SceneSpec, preset: Preset, cache: Path) -> Cell:
    """The cell of a simulated scene; one that is not in the cache is photographed first."""
    folder = cache / "scenes" / f"{preset.size[0]}px-seed-{SEED}" / spec.folder
    if not folder.exists():
        plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
        write_scene(folder, plant, scene_cameras(spec, plant, preset), seed=spec.seed)
    axes = {"leaves": spec.num_leaves, "views": spec.num_views, "family": spec.family}
    return read_cell(folder, spec.folder.replace("/", "_"), axes)


def read_cell(folder: Path, name: str, axes: Record) -> Cell:
    """The cell of an existing scene folder.

    Raises:
        InputError: the folder has no cameras or no true labels; see `load_scene` and `read_label_png`.
    """
    scene = load_scene(folder)
    maps = []
    for view, (width, height) in zip(scene.views, scene.cameras.sizes.tolist(), strict=True):
        if view.lens is not None:
            raise InputError(f"{folder}: view {view.name} has lens distortion, expected undistorted photos and labels")
        maps.append(read_label_png(folder / "truth" / f"{view.name}.png", width, height))
    return Cell(name=name, axes=axes, folder=folder, scene=scene, truth=tuple(maps))


def keep_record(path: Path, make: Callable[[], Record]) -> Record:
    """The record in a file; where there is none it is made and written.

    A change of the code does not make old records again: delete the cache's folder `records`, or the affected part.
    """
    if path.is_file():
        return read_record(path)
    record = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text_whole(path, json.dumps(record))
    return record


def read_record(path: Path) -> Record:
    record: Record = json.loads(path.read_text(encoding="utf-8"))
    return record
