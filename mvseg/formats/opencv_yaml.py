"""Calibrations in YAML, as OpenCV's `cv::FileStorage` and ROS's camera_calibration write them: K, distortion and size.

OpenCV puts the centre of the top-left pixel at (0, 0), so half a pixel is added to the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap
import yaml  # type: ignore[import-untyped]
from pydantic import BaseModel, Field, FiniteFloat

from mvseg.errors import InputError
from mvseg.formats.image_file import file_name_problem
from mvseg.formats.json_file import Pixels, check_content
from mvseg.formats.lens import opencv_lens
from mvseg.formats.text_file import read_yaml

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
        width, height: pixels; None where the file does not say.
    """

    K: np.ndarray
    distortion: tuple[float, ...]
    is_fisheye: bool
    width: int | None
    height: int | None

    def lens(self, width: int, height: int) -> pycolmap.Camera | None:
        """The lens of photos of this size; None for a pinhole. Raises InputError for skew with distortion."""
        return opencv_lens(self.K, self.distortion, width=width, height=height, is_fisheye=self.is_fisheye)


class _Content(BaseModel):
    matrix: Annotated[list[FiniteFloat], Field(min_length=9, max_length=9)]
    distortion: Annotated[list[FiniteFloat], Field(max_length=14)] = []
    width: Pixels | None = None
    height: Pixels | None = None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Reads OpenCV's matrices as plain mappings."""


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, _, node: loader.construct_mapping(node, deep=True)
)


def read_calibration(folder: Path, file: str) -> Calibration:
    """Read a calibration file; its path is relative to the scene's folder. Raises InputError, which names the file, if
    it leads out of the scene, cannot be read, or holds no camera matrix, or a distortion that is not supported."""
    if problem := file_name_problem(file):
        raise InputError(f"{file}: {problem}")
    path = folder / file
    entries = read_yaml(path, EXPECTED, loader=_Loader)
    if not isinstance(entries, dict):
        raise InputError(f"{path}: is not a calibration, expected {EXPECTED}")
    of_kalibr = [str(key) for key, each in entries.items() if isinstance(each, dict) and "distortion_coeffs" in each]
    if of_kalibr:
        mend = "camera_matrix of its intrinsics (fu, fv, pu, pv), distortion_coefficients of its distortion_coeffs"
        mend += ", distortion_model plumb_bob (its radtan) or equidistant, image_width and image_height"
        what = f"is Kalibr's, of {', '.join(of_kalibr)}"
        raise InputError(f"{path}: {what}; expected one camera a file, in OpenCV's form: {mend}")
    entries = {str(key).lower().replace("_", ""): value for key, value in entries.items()}
    calibration = {name: entries[key] for name, keys in NAMES.items() for key in reversed(keys) if key in entries}
    if isinstance(entries.get("imagesize"), list) and len(entries["imagesize"]) == 2:
        calibration = dict(zip(("width", "height"), entries["imagesize"], strict=True)) | calibration
    for name in {"matrix", "distortion"} & calibration.keys():
        rows = calibration[name].get("data") if isinstance(calibration[name], dict) else calibration[name]
        if isinstance(rows, list):  # nested or not
            rows = [x for row in rows for x in (row if isinstance(row, list) else [row])]
        calibration[name] = rows
    content = check_content(path, calibration, _Content, expected=EXPECTED)
    K = np.array(content.matrix).reshape(3, 3)
    K[:2, 2] += 0.5
    model = str(entries.get("distortionmodel") or "plumb_bob")
    is_fisheye = model in FISHEYES or bool(entries.get("fisheyemodel"))
    distortion = content.distortion[:8]
    if np.any(entries.get("xi") or 0):
        raise InputError(f"{path}: is of an omnidirectional lens (xi), which is not supported")
    if len(content.distortion) == 4 and any(distortion) and not {"distortionmodel", "fisheyemodel"} & entries.keys():
        mend = "k1, k2, p1, p2 (distortion_model: plumb_bob), or k1 to k4 of a fisheye (distortion_model: equidistant)?"
        raise InputError(f"{path}: has 4 distortion coefficients without a model: {mend}")
    if model not in ("plumb_bob", "rational_polynomial", *FISHEYES):
        raise InputError(f"{path}: the distortion model '{model}' is not known, expected plumb_bob or equidistant")
    if any(content.distortion[8:]):
        raise InputError(f"{path}: has a thin prism or a tilted sensor (coefficients 9 to 14), which is not supported")
    if len(distortion) not in ((4,) if is_fisheye else (0, 4, 5, 8)):
        raise InputError(f"{path}: has {len(distortion)} distortion coefficients, expected 4, 5 or 8, of a fisheye 4")
    return Calibration(K, tuple(distortion), is_fisheye=is_fisheye, width=content.width, height=content.height)
