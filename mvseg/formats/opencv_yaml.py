"""Calibrations in YAML, as OpenCV's `cv::FileStorage` and ROS's camera_calibration write them: K, distortion and size.

OpenCV puts the centre of the top-left pixel at (0, 0), so half a pixel is added to the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import yaml  # type: ignore[import-untyped]
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from mvseg.errors import InputError
from mvseg.formats.image_file import file_name_problem
from mvseg.formats.json_file import Pixels
from mvseg.formats.lens import opencv_lens
from mvseg.formats.yaml_file import read_yaml

EXPECTED = "camera_matrix and distortion_coefficients, as OpenCV or ROS writes them"
# Names that tools use, in small letters and without "_".
NAMES = {
    "matrix": ("cameramatrix", "k", "m", "mtx", "intrinsicmatrix"),
    "distortion": ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distortion", "dist", "d"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
}
FISHEYES = ("equidistant", "fisheye")


@dataclass(frozen=True, eq=False)
class Calibration:
    """One camera without its pose.

    Attributes:
        K: (3, 3) float64, in this project's pixels (the centre of the top-left one is (0.5, 0.5)).
        distortion: OpenCV's coefficients; k1 to k4 of a fisheye.
        is_fisheye: whether they are of `cv::fisheye`.
        width: pixels; None where the file does not say.
        height: pixels; None where the file does not say.
    """

    K: np.ndarray
    distortion: tuple[float, ...]
    is_fisheye: bool
    width: int | None
    height: int | None


class _Matrix(BaseModel):
    data: list[FiniteFloat] = Field(max_length=14)


class _Content(BaseModel):
    matrix: _Matrix
    distortion: _Matrix = _Matrix(data=[])
    width: Pixels | None = None
    height: Pixels | None = None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Reads OpenCV's matrices as plain mappings."""


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, _, node: loader.construct_mapping(node, deep=True)
)


def read_calibration(folder: Path, file: str) -> Calibration:
    """Read a calibration file.

    Args:
        folder: the scene.
        file: path relative to it.

    Raises:
        InputError: the file leads out of the scene, cannot be read, or holds no camera matrix, or a distortion that is
            not supported. The message names the file.
    """
    problem = file_name_problem(file)
    if problem:
        raise InputError(f"{file}: {problem}")
    path = folder / file
    entries = _read_entries(path)
    found = {name: entries[key] for name, keys in NAMES.items() for key in reversed(keys) if key in entries}
    if isinstance(entries.get("imagesize"), list) and len(entries["imagesize"]) == 2:
        found = dict(zip(("width", "height"), entries["imagesize"], strict=True)) | found
    for name in ("matrix", "distortion"):
        if isinstance(found.get(name), list):  # plain lists, nested or not
            rows = found[name]
            found[name] = {"data": [x for row in rows for x in (row if isinstance(row, list) else [row])]}
    try:
        content = _Content.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path}: {where}: {first['msg']}, expected {EXPECTED}") from None
    if len(content.matrix.data) != 9:
        raise InputError(f"{path}: the camera matrix has {len(content.matrix.data)} numbers, expected 9")
    K = np.array(content.matrix.data).reshape(3, 3)
    K[:2, 2] += 0.5
    is_fisheye, distortion = _is_fisheye(path, entries), _check_distortion(path, content.distortion.data)
    if is_fisheye and len(distortion) != 4:
        raise InputError(f"{path}: a fisheye with {len(distortion)} coefficients, expected k1, k2, k3, k4")
    return Calibration(K=K, distortion=distortion, is_fisheye=is_fisheye, width=content.width, height=content.height)


def calibration_lens(calibration: Calibration, width: int, height: int) -> pycolmap.Camera | None:
    """The lens of a calibrated camera, None for a pinhole.

    Raises:
        InputError: K has skew together with distortion.
    """
    K, numbers = calibration.K, calibration.distortion
    return opencv_lens(K, numbers, width=width, height=height, is_fisheye=calibration.is_fisheye)


def _read_entries(path: Path) -> dict[str, Any]:
    """The top level of the file, keys in small letters and without "_"."""
    entries = read_yaml(path, EXPECTED, loader=_Loader)
    if not isinstance(entries, dict):
        raise InputError(f"{path}: is not a calibration, expected {EXPECTED}")
    return {str(key).lower().replace("_", ""): value for key, value in entries.items()}


def _is_fisheye(path: Path, entries: dict[str, Any]) -> bool:
    model = str(entries.get("distortionmodel") or "plumb_bob")
    if model not in ("plumb_bob", "rational_polynomial", *FISHEYES):
        raise InputError(f"{path}: the distortion model '{model}' is not known, expected plumb_bob or equidistant")
    return model in FISHEYES or bool(entries.get("fisheyemodel"))


def _check_distortion(path: Path, numbers: list[float]) -> tuple[float, ...]:
    """Four, five or eight coefficients; the thin prism and tilt of OpenCV must be 0."""
    if any(numbers[8:]):
        raise InputError(f"{path}: has a thin prism or a tilted sensor (coefficients 9 to 14), which is not supported")
    kept = numbers[:8]
    if len(kept) not in (0, 4, 5, 8):
        raise InputError(f"{path}: has {len(kept)} distortion coefficients, expected 4, 5 or 8")
    return tuple(kept)
