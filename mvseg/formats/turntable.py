"""The turntable file `turntable.json`: one or more fixed, calibrated cameras, an axis, and an angle per photo.

    {"format": "mvseg-turntable/1", "unit": "mm",
     "axis": {"point": [0, 0, 0], "direction": [0, 0, 1]},
     "cameras": {"top": {"width": W, "height": H, "K": 3x3, "R": 3x3, "t": 3, "distortion": [k1, k2, p1, p2, k3]},
                 "side": {"calibration": "side.yaml", "R": 3x3, "t": 3}},
     "views": [{"file": "images/top_000.jpg", "camera": "top", "angle": 0},
               {"file": "images/top_030.jpg", "camera": "top", "angle": 30}]}

A camera is given as in a rig file; its R and t hold at the angle 0. The world is fixed to the table and turns with it.
`angle` is in degrees and says how far the table has turned: anticlockwise, if the direction of the axis points towards
the viewer. If the cameras move around a plant that stands still, the angles have the opposite sign.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError, faults_of
from mvseg.formats.json_file import Items, Vector3, read_json
from mvseg.formats.photos import build_scene
from mvseg.formats.rig import RigCamera, photo_of, warn_of_unknown_keys
from mvseg.scene import Scene

TURNTABLE_FORMAT = "mvseg-turntable/1"


class _Axis(BaseModel):
    model_config = ConfigDict(extra="forbid")
    point: Vector3
    direction: Vector3


class _View(BaseModel):
    model_config = ConfigDict(extra="allow")
    file: str
    camera: str
    angle: FiniteFloat


class _Turntable(BaseModel):
    model_config = ConfigDict(extra="allow")
    format: Literal["mvseg-turntable/1"]
    unit: str = ""
    axis: _Axis
    cameras: dict[str, RigCamera]
    views: Items[_View]


def read_turntable(path: Path) -> Scene:
    """Read the scene of a turntable file; photos are looked for beside it. Warns (InputWarning) of unknown keys. Raises
    InputError if the file is missing, broken or of another format, a view names no camera of the file, the axis has no
    direction, or a camera is unsound; see `photo_of` and `build_scene`."""
    table = _read_table(path)
    owners = [("the turntable", table), *((f"camera {name}", each) for name, each in table.cameras.items())]
    warn_of_unknown_keys(path, [*owners, *((f"view {index}", view) for index, view in enumerate(table.views))])
    if not any(table.axis.direction):
        raise InputError(f"{path}: the direction of the axis is 0, 0, 0, expected a vector along the axis")
    photos = []
    for index, view in enumerate(table.views):
        with faults_of(f"{path}: view {index} ({view.file})"):
            photo = photo_of(path.parent, view.file, table.cameras[view.camera])
        turn, shift = turn_about(np.array(table.axis.point), np.array(table.axis.direction), view.angle)
        photos.append(dataclasses.replace(photo, R=photo.R @ turn, t=photo.R @ shift + photo.t))
    return build_scene(path.parent, photos, unit=table.unit, source=path)


def _read_table(path: Path) -> _Turntable:
    table = read_json(path, _Turntable)
    for index, view in enumerate(table.views):
        if view.camera not in table.cameras:
            there = f"there is no camera '{view.camera}', expected of these: {', '.join(table.cameras)}"
            raise InputError(f"{path}: view {index} ({view.file}): {there}")
    return table


def read_turntable_parts(path: Path) -> tuple[dict[str, dict[str, Any]], list[tuple[str, float]], str]:
    """Read what `write_turntable` takes, of a turntable whose axis is the world's z axis: the cameras (as in a rig
    file) by name, the camera and the angle of each view in order, and the unit. Raises InputError if the file cannot be
    read, has no camera or another axis, a view names no camera of it, or a camera has no K and size, or a distortion of
    more than five numbers."""
    table = _read_table(path)
    axis = table.axis
    if not table.cameras or (*axis.point, *axis.direction) != (0.0, 0.0, 0.0, 0.0, 0.0, 1.0):
        raise InputError(f"{path}: expected cameras and the axis 0 0 1 at 0 0 0, as mvseg pose writes it")
    cameras = {name: camera.model_dump(exclude_none=True) for name, camera in table.cameras.items()}
    for name, camera in cameras.items():
        if not {"K", "width", "height"} <= camera.keys():
            message = f"camera {name} has no K, width and height"
            raise InputError(f"{path}: {message}, expected a file of mvseg pose --turntable")
        if len(camera.get("distortion", [])) > 5:
            raise InputError(f"{path}: the distortion of camera {name} is not k1, k2, p1, p2, k3")
    return cameras, [(view.camera, view.angle) for view in table.views], table.unit


def write_turntable(
    path: Path, cameras: Mapping[str, dict[str, Any]], views: Sequence[tuple[str, str, float]], *, unit: str
) -> None:
    """Write the file of cameras beside a table whose axis is the world's z axis, into a folder that exists. `cameras`
    hold width, height, K, R, t and distortion, as in a rig file, by name; `views` the file, camera and angle in degrees
    of each photo."""
    content = {
        "format": TURNTABLE_FORMAT,
        "unit": unit,
        "axis": {"point": [0, 0, 0], "direction": [0, 0, 1]},
        "cameras": cameras,
        "views": [{"file": file, "camera": camera, "angle": angle} for file, camera, angle in views],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def turn_about(point: np.ndarray, direction: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """A turn about an axis: (3, 3) rotation and (3,) translation, so that X goes to rotation @ X + translation."""
    axis = direction / np.abs(direction).max()  # first, so that no length overflows
    axis /= np.linalg.norm(axis)
    turn = Rotation.from_rotvec(axis * np.radians(degrees % 360)).as_matrix()
    return turn, point - turn @ point
