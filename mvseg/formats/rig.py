"""The rig file `cameras.json`: OpenCV's K, R, t and distortion, one entry per view.

    {"format": "mvseg-rig/1", "unit": "mm", "up": [0, 0, 1], "views": [
        {"file": "images/000.jpg", "width": W, "height": H, "K": 3x3, "R": 3x3, "t": 3,
         "distortion": [k1, k2, p1, p2, k3]}]}

R and t are cam_from_world; the centre of the top-left pixel is (0.5, 0.5). `distortion` may be left out, and so may
the size, which then is that of the photo, and `unit` and `up`, the direction that points up in the world, where they
are not known. `"calibration": "camera.yaml"` stands for K, distortion and size (OpenCV's file).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat

from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding
from mvseg.formats.json_file import Items, Matrix3, Pixels, Vector3, load_json, read_json
from mvseg.formats.lens import opencv_distortion
from mvseg.formats.opencv_yaml import Calibration, read_calibration
from mvseg.formats.photos import Photo, build_scene, size_of_photo
from mvseg.scene import Scene

RIG_FORMAT = "mvseg-rig/1"
MANY = 10  # limit: unknown keys of one view that are named


class RigCamera(BaseModel):
    """A camera as it stands in the file; `photo_of` checks what belongs together."""

    model_config = ConfigDict(extra="allow")
    width: Pixels | None = None
    height: Pixels | None = None
    K: Matrix3 | None = None
    calibration: str | None = None
    R: Matrix3
    t: Vector3
    distortion: Items[FiniteFloat] | None = None


class _RigView(RigCamera):
    file: str


class _Rig(BaseModel):
    model_config = ConfigDict(extra="allow")
    format: Literal["mvseg-rig/1"]
    unit: str = ""
    up: Vector3 | None = None
    views: Items[_RigView]


def is_rig(path: Path) -> bool:
    """Whether a cameras.json is meant as a rig file, valid or not; other programs (3D Gaussian splatting) use this
    name, too."""
    with suppress(InputError):  # `read_rig` says what is wrong
        content = load_json(path)
        return isinstance(content, dict) and ("views" in content or str(content.get("format")).startswith("mvseg"))
    return True


def read_rig(path: Path) -> Scene:
    """Read the scene of a rig file; photos are looked for beside it. Warns (InputWarning) of unknown keys: a misspelt
    "distortion" must not pass unseen. Raises InputError if the file is missing, broken or of another format, or holds
    unsound cameras; see `build_scene`."""
    rig = read_json(path, _Rig)
    warn_of_unknown_keys(path, [("the rig", rig), *((f"view {i}", view) for i, view in enumerate(rig.views))])
    photos = []
    for index, view in enumerate(rig.views):
        with faults_of(f"{path}: view {index} ({view.file})"):
            photos.append(photo_of(path.parent, view.file, view))
    return build_scene(path.parent, photos, unit=rig.unit, source=path, up=rig.up)


def warn_of_unknown_keys(path: Path, entries: Iterable[tuple[str, BaseModel]]) -> None:
    """Say (InputWarning) which keys of the named entries of a file are not used."""
    for owner, entry in entries:
        for key in list(entry.model_extra or {})[:MANY]:
            warn(Finding("unknown_key", str(path), {"key": key, "owner": owner}))


def photo_of(folder: Path, file: str, camera: RigCamera) -> Photo:
    """A photo with its camera, complete: `folder` is the scene, where the photo and a calibration are looked for.
    Raises InputError, with a reason, if there is not exactly one of K and a calibration, the calibration cannot be read
    or is of another size, the size is not known, or the distortion is not a model of OpenCV."""
    calibration, given = _calibration(folder, camera), (camera.width, camera.height)
    width, height = calibration.width or camera.width, calibration.height or camera.height
    if width is None or height is None:
        width, height = size_of_photo(folder, file)
    if camera.calibration and any(one not in (None, side) for one, side in zip(given, (width, height), strict=True)):
        raise InputError(f"the calibration is of {width} x {height} pixels, the camera says {given[0]} x {given[1]}")
    R, t, lens = np.array(camera.R), np.array(camera.t), calibration.lens(width, height)
    return Photo(file=file, width=width, height=height, K=calibration.K, R=R, t=t, lens=lens)


def _calibration(folder: Path, camera: RigCamera) -> Calibration:
    distortion = camera.distortion or []
    if (camera.K is None) == (camera.calibration is None):
        raise InputError("expected either K or a calibration file")
    if camera.calibration is not None:
        if distortion:
            raise InputError("distortion beside a calibration file, expected one of them")
        return read_calibration(folder, camera.calibration)
    if len(distortion) not in (0, 4, 5, 8):
        raise InputError(f"distortion has {len(distortion)} numbers, expected k1, k2, p1, p2, k3")
    return Calibration(np.array(camera.K), tuple(distortion), is_fisheye=False, width=None, height=None)


def write_rig(path: Path, scene: Scene, files: list[str]) -> None:
    """Write a rig file into a folder that exists: cameras, whose lenses must be OpenCV's, unit and up of `scene`;
    `files` are V photo paths relative to that folder."""
    cameras, views = scene.cameras, []
    for index, file in enumerate(files):
        width, height = cameras.sizes[index].tolist()
        view = {"file": file, "width": width, "height": height}
        view |= {name: getattr(cameras, name)[index].tolist() for name in ("K", "R", "t")}
        if distortion := opencv_distortion(scene.views[index].lens):
            view["distortion"] = distortion
        views.append(view)
    world = {"unit": scene.unit} | ({} if scene.up is None else {"up": scene.up})
    path.write_text(json.dumps({"format": RIG_FORMAT, **world, "views": views}, indent=1) + "\n")
