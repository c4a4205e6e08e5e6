"""Calibrations that OpenCV itself writes, and ROS's form, against OpenCV's own projection."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.opencv_yaml import read_calibration

MATRIX = np.array([[1234.5678901234567, 0, 640.25], [0, 1230.1, 355.75], [0, 0, 1]])
DISTORTION = np.array([[-0.12, 0.034, 1.0e-05, -0.0021, 0.005]])
POINTS = np.random.default_rng(5).uniform(-1, 1, (20, 3)) * [0.4, 0.25, 0.3] + [0, 0, 2]


def write_opencv(path: Path, **entries: object) -> None:
    """By OpenCV's FileStorage, as its calibration samples do."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()


def project(folder: Path, file: str) -> np.ndarray:
    """Pixels of POINTS in this project's coordinates, lens included."""
    calibration = read_calibration(folder, file)
    lens = calibration.lens(calibration.width or 1, calibration.height or 1)
    pinhole = POINTS @ calibration.K.T
    xy = pinhole[:, :2] / pinhole[:, 2:]
    return xy if lens is None else photo_from_pinhole(lens, calibration.K, xy)


@pytest.mark.parametrize("head", ["%YAML 1.2", "%YAML:1.0"])  # of OpenCV 5, and of those before
@pytest.mark.parametrize("number", [0, 4, 5, 8, 14])
def test_opencvs_files_agree_with_its_projection(number: int, head: str, tmp_path: Path) -> None:
    distortion = np.zeros((1, number))
    distortion[0, : min(number, 8)] = np.resize(DISTORTION, min(number, 8))
    entries = {"distortion_coefficients": distortion} if number else {}
    if number == 4:  # of a fisheye, otherwise
        entries["distortion_model"] = "plumb_bob"
    write_opencv(tmp_path / "a.yaml", image_width=1280, image_height=720, camera_matrix=MATRIX, **entries)
    _, _, rest = (tmp_path / "a.yaml").read_text().partition("\n")
    assert "!!opencv-matrix" in rest
    (tmp_path / "a.yaml").write_text(f"{head}\n{rest}")
    calibration = read_calibration(tmp_path, "a.yaml")
    assert (calibration.width, calibration.height) == (1280, 720)
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, distortion if number else None)
    np.testing.assert_allclose(project(tmp_path, "a.yaml"), expected[:, 0] + 0.5, atol=1e-9)


def test_fisheyes_agree_with_opencvs(tmp_path: Path) -> None:
    distortion = np.array([0.05, -0.01, 0.002, 0.001])
    write_opencv(tmp_path / "a.yml", K=MATRIX, D=distortion.reshape(4, 1), fisheye_model=1)
    expected, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), MATRIX, distortion)
    np.testing.assert_allclose(project(tmp_path, "a.yml"), expected[:, 0] + 0.5, atol=1e-9)
    calibration = read_calibration(tmp_path, "a.yml")
    assert (calibration.width, calibration.height) == (None, None)


ROS = """image_width: 1280
image_height: 720
camera_name: plant
camera_matrix:
  rows: 3
  cols: 3
  data: [1234.5678901234567, 0., 640.25, 0., 1230.1, 355.75, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.12, 0.034, 1e-05, -0.0021, 0.005]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def test_ros_files_and_plain_lists(tmp_path: Path) -> None:
    (tmp_path / "ros.yaml").write_text(ROS)
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)
    np.testing.assert_allclose(project(tmp_path, "ros.yaml"), expected[:, 0] + 0.5, atol=1e-9)
    (tmp_path / "a.yaml").write_text(f"mtx: {MATRIX.tolist()}\ndist: {DISTORTION.tolist()}\nimageSize: [1280, 720]\n")
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)
    np.testing.assert_allclose(project(tmp_path, "a.yaml"), expected[:, 0] + 0.5, atol=1e-9)
    assert read_calibration(tmp_path, "a.yaml").width == 1280


BAD = [
    ("", "is not a calibration, expected camera_matrix"),
    ("a: !!python/object/apply:os.getcwd []", r"is not a YAML file"),
    (ROS.replace("camera_matrix", "camera_matirx"), "matrix: Field required, expected camera_matrix"),
    (ROS.replace("1234.5678901234567", ".nan"), r"matrix\[0\]: Input should be a finite number"),
    (ROS.replace("1234.5678901234567, ", ""), "matrix: List should have at least 9 items"),
    (ROS.replace("-0.12, ", "-0.12, 1, "), "has 6 distortion coefficients, expected 4, 5 or 8"),
    (ROS.replace("[-0.12,", "[0, 0, 0, 0, 0, 0, -0.12,"), r"has a thin prism or a tilted sensor"),
    (ROS.replace("plumb_bob", "omni"), "the distortion model 'omni' is not known, expected plumb_bob or equidistant"),
    (ROS.replace("plumb_bob", "equidistant"), "has 5 distortion coefficients, expected 4, 5 or 8, of a fisheye 4"),
    (ROS.replace("1280", "-1"), "width: Input should be greater than or equal to 1"),
    ("#" * (1 << 20) + "\n", "is larger than 1048576 bytes"),
    ("\0", r"is not a YAML file"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_bad_files_are_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"a.yaml: {message}"):
        read_calibration(tmp_path, "a.yaml")


def test_skew_beside_distortion(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(ROS.replace("0., 640.25", "3., 640.25"))
    with pytest.raises(InputError, match="K has skew together with distortion"):
        read_calibration(tmp_path, "a.yaml").lens(1280, 720)
