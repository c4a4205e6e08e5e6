"""nerfstudio's `transforms.json`: world_from_cam in OpenGL axes (+y up, -z forward), intrinsics per file or frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from pydantic import BaseModel, FiniteFloat

from mvseg.errors import InputError
from mvseg.formats.json_file import Pixels, read_json
from mvseg.formats.photos import Photo, build_scene
from mvseg.formats.rig import opencv_lens
from mvseg.scene import Scene

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
Row4 = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _Intrinsics(BaseModel):
    camera_model: str | None = None
    w: Pixels | None = None
    h: Pixels | None = None
    fl_x: FiniteFloat | None = None
    fl_y: FiniteFloat | None = None
    cx: FiniteFloat | None = None
    cy: FiniteFloat | None = None
    k1: FiniteFloat | None = None
    k2: FiniteFloat | None = None
    k3: FiniteFloat | None = None
    k4: FiniteFloat | None = None
    p1: FiniteFloat | None = None
    p2: FiniteFloat | None = None


class _Frame(_Intrinsics):
    file_path: str
    transform_matrix: tuple[Row4, Row4, Row4] | tuple[Row4, Row4, Row4, Row4]


class _Transforms(_Intrinsics):
    frames: list[_Frame]


def read_transforms(path: Path) -> Scene:
    """The scene of a transforms.json; its unit is unknown (""). A frame's own intrinsics override those of the file.

    Raises:
        InputError: the file is missing or broken, an intrinsic is missing, the camera model is not known, or a camera
            is unsound; see `build_scene`.
    """
    transforms = read_json(path, _Transforms)
    shared = transforms.model_dump(exclude={"frames"}, exclude_none=True)
    photos = []
    for index, frame in enumerate(transforms.frames):
        of_frame = frame.model_dump(exclude={"file_path", "transform_matrix"}, exclude_none=True)
        try:
            photos.append(_photo(path.parent, frame, shared | of_frame))
        except InputError as error:
            raise InputError(f"{path}: frame {index} ({frame.file_path}): {error}") from None
    return build_scene(path.parent, photos, unit="", source=path)


def _photo(folder: Path, frame: _Frame, intrinsics: dict) -> Photo:
    for key in ("w", "h", "fl_x", "cx", "cy"):
        if key not in intrinsics:
            raise InputError(f"'{key}' is missing")
    width, height, fx = intrinsics["w"], intrinsics["h"], intrinsics["fl_x"]
    fy = intrinsics.get("fl_y", fx)
    K = np.array([[fx, 0, intrinsics["cx"]], [0, fy, intrinsics["cy"]], [0, 0, 1.0]])
    world_from_cam = np.array(frame.transform_matrix)
    if world_from_cam[3:].tolist() not in ([], [[0.0, 0.0, 0.0, 1.0]]):
        raise InputError("the last row of transform_matrix is not 0, 0, 0, 1")
    R = (world_from_cam[:3, :3] @ OPENGL_FROM_OPENCV).T
    file = frame.file_path
    if not (folder / file).is_file():  # nerfstudio allows leaving out ".png"
        file = next((file + end for end in (".png", ".jpg", ".jpeg") if (folder / (file + end)).is_file()), file)
    t = -R @ world_from_cam[:3, 3]
    return Photo(file=file, width=width, height=height, K=K, R=R, t=t, lens=_lens(intrinsics, K))


def _lens(intrinsics: dict, K: np.ndarray) -> pycolmap.Camera | None:
    model, width, height = intrinsics.get("camera_model", "OPENCV"), intrinsics["w"], intrinsics["h"]
    k1, k2, k3, k4, p1, p2 = (intrinsics.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, k3, k4]
        return pycolmap.Camera(model=model, width=width, height=height, params=params)
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise InputError(f"the camera model '{model}' is not known, expected OPENCV, OPENCV_FISHEYE or PINHOLE")
    if k4:
        raise InputError(f"k4 is {k4:g} in the model {model}, expected 0 (a term in r^8 is not supported)")
    if not any((k1, k2, k3, p1, p2)):
        return None
    return opencv_lens(K, [k1, k2, p1, p2, k3], width=width, height=height)
