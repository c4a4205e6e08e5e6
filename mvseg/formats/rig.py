"""The rig file `cameras.json`: OpenCV's K, R, t and distortion, one entry per view.

    {"format": "mvseg-rig/1", "unit": "mm", "up": [0, 0, 1], "views": [
        {"file": "images/000.jpg", "width": W, "height": H, "K": 3x3, "R": 3x3, "t": 3,
         "distortion": [k1, k2, p1, p2, k3]}]}

R and t are cam_from_world; the centre of the top-left pixel is (0.5, 0.5). `distortion` may be left out, `unit` and
`up`, the direction that points up in the world, as well where they are not known.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from pydantic import BaseModel, ConfigDict, FiniteFloat

from mvseg.errors import InputError, InputWarning
from mvseg.formats.json_file import Matrix3, Pixels, Vector3, read_json
from mvseg.formats.photos import Photo, build_scene
from mvseg.scene import Scene

RIG_FORMAT = "mvseg-rig/1"


class _RigView(BaseModel):
    model_config = ConfigDict(extra="allow")
    file: str
    width: Pixels
    height: Pixels
    K: Matrix3
    R: Matrix3
    t: Vector3
    distortion: list[FiniteFloat] | None = None


class _Rig(BaseModel):
    model_config = ConfigDict(extra="allow")
    format: Literal["mvseg-rig/1"]
    unit: str = ""
    up: Vector3 | None = None
    views: list[_RigView]


def read_rig(path: Path) -> Scene:
    """The scene of a rig file; photos are looked for beside it. Warns (InputWarning) of unknown keys: a misspelt
    "distortion" must not pass unseen.

    Raises:
        InputError: the file is missing, broken or of another format, or holds unsound cameras; see `build_scene`.
    """
    rig = read_json(path, _Rig)
    for owner, entry in [("the rig", rig), *((f"view {i}", view) for i, view in enumerate(rig.views))]:
        for key in entry.model_extra or {}:
            warnings.warn(f"{path}: key '{key}' of {owner} is not known and not used", InputWarning, stacklevel=2)
    photos = [_photo(path, index, view) for index, view in enumerate(rig.views)]
    scene = build_scene(path.parent, photos, unit=rig.unit, source=path)
    try:
        return replace(scene, up=rig.up)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _photo(path: Path, index: int, view: _RigView) -> Photo:
    K, lens = np.array(view.K), None
    if view.distortion and len(view.distortion) not in (4, 5, 8):
        raise InputError(
            f"{path}: view {index} ({view.file}): distortion has {len(view.distortion)} numbers, "
            "expected k1, k2, p1, p2, k3"
        )
    if view.distortion and any(view.distortion):
        if K[0, 1] != 0:
            raise InputError(f"{path}: view {index} ({view.file}): K has skew together with distortion, expected none")
        lens = opencv_lens(K, view.distortion, width=view.width, height=view.height)
    R, t = np.array(view.R), np.array(view.t)
    return Photo(file=view.file, width=view.width, height=view.height, K=K, R=R, t=t, lens=lens)


def opencv_lens(K: np.ndarray, distortion: list[float], *, width: int, height: int) -> pycolmap.Camera:
    """OpenCV's k1, k2, p1, p2 (, k3 (, k4, k5, k6)) as COLMAP's FULL_OPENCV; K in this project's pixels."""
    coefficients = [*distortion, *[0.0] * (8 - len(distortion))]
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients]
    return pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params)


def write_rig(
    path: Path, scene: Scene, files: list[str], *, distortion: list[list[float] | None] | None = None
) -> None:
    """Write a rig file.

    Args:
        path: where; its folder must exist.
        scene: gives the cameras, the unit and the direction that points up.
        files: V photo paths relative to the folder of `path`.
        distortion: V lists of OpenCV coefficients, or None for pinholes.
    """
    cameras, views = scene.cameras, []
    for index, file in enumerate(files):
        width, height = cameras.sizes[index].tolist()
        view = {"file": file, "width": width, "height": height}
        view |= {name: getattr(cameras, name)[index].tolist() for name in ("K", "R", "t")}
        if distortion and distortion[index]:
            view["distortion"] = distortion[index]
        views.append(view)
    world = {"unit": scene.unit} | ({} if scene.up is None else {"up": scene.up})
    path.write_text(json.dumps({"format": RIG_FORMAT, **world, "views": views}, indent=1) + "\n")
