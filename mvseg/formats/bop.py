"""BOP's `scene_camera.json`: K and pose of each image of a scene folder, photos in `rgb/` or `gray/`; millimetres.

    {"0": {"cam_K": 9 numbers, "cam_R_w2c": 9 numbers, "cam_t_w2c": 3 numbers, "depth_scale": 1.0}, ...}

Poses are cam_from_world. BOP's cameras come from OpenCV and BlenderProc, which put the centre of the top-left pixel at
(0, 0): half a pixel is added. The size is that of the photo.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, RootModel

from mvseg.errors import InputError, faults_of
from mvseg.formats.image_file import PHOTO_SUFFIXES
from mvseg.formats.json_file import Vector3, read_json
from mvseg.formats.photos import Photo, build_scene, size_of_photo
from mvseg.scene import Scene


class _Camera(BaseModel):
    cam_K: list[FiniteFloat] = Field(min_length=9, max_length=9)
    cam_R_w2c: list[FiniteFloat] | None = Field(default=None, min_length=9, max_length=9)
    cam_t_w2c: Vector3 | None = None


class _Cameras(RootModel[dict[int, _Camera]]):
    pass


def read_bop(path: Path) -> Scene:
    """Read a scene_camera.json, views by number, called 000000, 000001, ... Raises InputError if the file is missing or
    broken, an image has no pose (BOP allows that) or no photo, or a camera is unsound; see `build_scene`."""
    photos = []
    for number, camera in sorted(read_json(path, _Cameras).root.items()):
        if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
            raise InputError(f"{path}: image {number} has no cam_R_w2c or cam_t_w2c, expected the pose of each camera")
        files = [f"{place}/{number:06d}{suffix}" for place in ("rgb", "gray") for suffix in PHOTO_SUFFIXES]
        file = next((file for file in files if (path.parent / file).is_file()), f"rgb/{number:06d}.png")
        with faults_of(f"{path}: image {number} ({file})"):
            width, height = size_of_photo(path.parent, file)
        K = np.array(camera.cam_K).reshape(3, 3)
        K[:2, 2] += 0.5
        R, t = np.array(camera.cam_R_w2c).reshape(3, 3), np.array(camera.cam_t_w2c)
        photos.append(Photo(file=file, width=width, height=height, K=K, R=R, t=t))
    return build_scene(path.parent, photos, unit="mm", source=path)
