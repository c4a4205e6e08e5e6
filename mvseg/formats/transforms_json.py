"""`transforms.json` of nerfstudio, instant-ngp and Blender: world_from_cam in OpenGL axes (+y up, -z forward).

nerfstudio's `applied_transform` and `applied_scale` are undone: the world is that of the cameras before nerfstudio
turned and scaled it (COLMAP's). Its `mask_path` marks what to train on and does not separate leaves, so it is not used.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pycolmap
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding
from mvseg.formats.json_file import Items, Pixels, read_json
from mvseg.formats.lens import opencv_lens
from mvseg.formats.photos import Photo, build_scene, size_of_photo
from mvseg.formats.rig import MANY
from mvseg.scene import ROTATION_TOLERANCE, Scene

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
Row4 = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Rows = tuple[Row4, Row4, Row4] | tuple[Row4, Row4, Row4, Row4]
# Keys of other lenses, or that move pixels or cameras, and are not read: they must be 0.
MOVING = (
    "k5", "k6", "s1", "s2", "s3", "s4", "xi", "skew", "rolling_shutter", "x_fov", "y_fov", "ftheta_p0", "latlong",
    "equirectangular", "is_latlong", "is_equirectangular",
)  # fmt: skip
# Keys that say nothing about cameras.
ASIDE = {
    "aabb_scale", "scale", "offset", "up", "from_na", "sharpness", "rotation", "colmap_im_id", "depth_file_path",
    "ply_file_path", "orientation_override", "train_filenames", "val_filenames", "test_filenames", "time", "fps",
    "n_frames", "integer_depth_scale", "white_transparent", "black_transparent", *MOVING,
}  # fmt: skip
LENS = ("k1", "k2", "k3", "k4", "p1", "p2")  # order of nerfstudio's distortion_params
Angle = Annotated[float, Field(gt=0, lt=math.pi)]


class _Intrinsics(BaseModel):
    model_config = ConfigDict(extra="allow")
    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
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
    distortion_params: Items[FiniteFloat] | None = None

    @property
    def intrinsics(self) -> dict[str, Any]:
        """Intrinsics that the file states; InputError where nerfstudio's list of coefficients does not fit."""
        stated = self.model_dump(include={*_Intrinsics.model_fields} - {"distortion_params"}, exclude_none=True)
        if self.distortion_params is None:
            return stated
        if len(self.distortion_params) != len(LENS):
            raise InputError(f"distortion_params are {len(self.distortion_params)} numbers, expected {', '.join(LENS)}")
        listed = dict(zip(LENS, self.distortion_params, strict=True))
        if others := [key for key in LENS if stated.get(key, listed[key]) != listed[key]]:
            raise InputError(f"{others[0]} is {stated[others[0]]:g}, and {listed[others[0]]:g} in distortion_params")
        return stated | listed


class _Frame(_Intrinsics):
    file_path: str
    transform_matrix: Rows
    mask_path: str | None = None


class _Transforms(_Intrinsics):
    frames: Items[_Frame]
    applied_transform: Rows | None = None
    applied_scale: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0


def read_transforms(path: Path) -> Scene:
    """Read the scene of a transforms.json; its unit is unknown (""). A frame's own intrinsics override those of the
    file. Where the file has no size it is that of the photo; where it has no focal length, `camera_angle_x` (Blender)
    gives it. Warns (InputWarning) of masks that are not used.

    Raises:
        InputError: the file is missing or broken, an intrinsic is missing, the camera model is not known, the applied
            transform is not a similarity, or a camera is unsound; see `build_scene`.
    """
    transforms = read_json(path, _Transforms)
    with faults_of(path):
        shared = transforms.intrinsics
    undo = _undo_applied(path, transforms)
    _check_keys(path, transforms)
    photos = []
    for index, frame in enumerate(transforms.frames):
        with faults_of(f"{path}: frame {index} ({frame.file_path})"):
            photos.append(_photo(path.parent, frame, _merge(shared, frame.intrinsics), undo=undo))
    if num_masks := sum(frame.mask_path is not None for frame in transforms.frames):
        warn(Finding("mask_paths_not_used", str(path), {"count": num_masks}))
    return build_scene(path.parent, photos, unit="", source=path)


def _check_keys(path: Path, transforms: _Transforms) -> None:
    unknown: dict[str, str] = {}
    for owner, entry in (("the file", transforms), *((each.file_path, each) for each in transforms.frames)):
        extra = entry.model_extra or {}
        for key in MOVING:
            if np.any(extra.get(key) or 0):
                raise InputError(f"{path}: '{key}' of {owner} is {extra[key]}, which is not supported, expected 0")
        for key in extra.keys() - ASIDE:
            unknown.setdefault(key, owner)
    for key, owner in sorted(unknown.items())[:MANY]:
        warn(Finding("unknown_key", str(path), {"key": key, "owner": owner}))


def _merge(shared: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Intrinsics of a frame: its own override those of the file, its angle of view the file's focal length."""
    angles, lengths = {"camera_angle_x", "camera_angle_y"}, {"fl_x", "fl_y"}
    replaced = angles | lengths if own.keys() & angles and not own.keys() & lengths else set()
    return {key: value for key, value in shared.items() if key not in replaced} | own


def _undo_applied(path: Path, transforms: _Transforms) -> tuple[np.ndarray, float]:
    """(4, 4) rigid, to the world before `applied_transform`, and the scale: X became scale * (applied_transform X)."""
    applied = np.eye(4)
    if transforms.applied_transform is not None:
        applied[:3] = np.array(transforms.applied_transform)[:3]
    R = applied[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise InputError(f"{path}: applied_transform is not a rotation with a translation, so it cannot be undone")
    return np.linalg.inv(applied), transforms.applied_scale


def _photo(folder: Path, frame: _Frame, given: dict[str, Any], *, undo: tuple[np.ndarray, float]) -> Photo:
    intrinsics = _complete(folder, frame, given)
    width, height, fx = intrinsics["w"], intrinsics["h"], intrinsics["fl_x"]
    K = np.array([[fx, 0, intrinsics["cx"]], [0, intrinsics.get("fl_y", fx), intrinsics["cy"]], [0, 0, 1.0]])
    world_from_cam = np.array(frame.transform_matrix)
    if (np.abs(world_from_cam[3:] - [0, 0, 0, 1]) > ROTATION_TOLERANCE).any():
        raise InputError("the last row of transform_matrix is not 0, 0, 0, 1")
    undo_applied, scale = undo
    R = (undo_applied[:3, :3] @ world_from_cam[:3, :3] @ OPENGL_FROM_OPENCV).T
    t = -R @ (undo_applied[:3, :3] @ world_from_cam[:3, 3] / scale + undo_applied[:3, 3])
    return Photo(file=frame.file_path, width=width, height=height, K=K, R=R, t=t, lens=_lens(intrinsics, K))


def _complete(folder: Path, frame: _Frame, given: dict[str, Any]) -> dict[str, Any]:
    """The intrinsics, with the size of the photo and the focal length of the angle of view where they are missing."""
    values = dict(given)
    if "w" not in values or "h" not in values:
        values = dict(zip(("w", "h"), size_of_photo(folder, frame.file_path), strict=True)) | given
    if "fl_x" not in values and values.keys() & {"camera_angle_x", "camera_angle_y"}:
        sides = {"x": values["w"], "y": values["h"]}
        of_angle = {axis: side / 2 / math.tan(values[f"camera_angle_{axis}"] / 2) for axis, side in sides.items()
                    if f"camera_angle_{axis}" in values}  # fmt: skip
        fx, fy = of_angle.get("x", of_angle.get("y")), of_angle.get("y", of_angle.get("x"))
        values = {"fl_y": fy, "cx": values["w"] / 2, "cy": values["h"] / 2} | values | {"fl_x": fx}
    for key in ("fl_x", "cx", "cy"):
        if key not in values:
            raise InputError(f"'{key}' is missing")
    return values


def _lens(intrinsics: dict, K: np.ndarray) -> pycolmap.Camera | None:
    model, width, height = intrinsics.get("camera_model", "OPENCV"), intrinsics["w"], intrinsics["h"]
    k1, k2, k3, k4, p1, p2 = (intrinsics.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE" or (intrinsics.get("is_fisheye") and "camera_model" not in intrinsics):
        return opencv_lens(K, [k1, k2, k3, k4], width=width, height=height, is_fisheye=True)
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise InputError(f"the camera model '{model}' is not known, expected OPENCV, OPENCV_FISHEYE or PINHOLE")
    if "camera_model" not in intrinsics and "is_fisheye" not in intrinsics and (k3 or k4) and not (p1 or p2):
        raise InputError("k3 or k4 without a camera_model: of a fisheye (OPENCV_FISHEYE), or of a plain lens (OPENCV)?")
    if k4:
        mend = "a term in r^8 is not supported; of a fisheye, the camera_model is OPENCV_FISHEYE"
        raise InputError(f"k4 is {k4:g} in the model {model}, expected 0 ({mend})")
    return opencv_lens(K, [k1, k2, p1, p2, k3], width=width, height=height)
