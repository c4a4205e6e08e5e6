"""nerfstudio's transforms.json against poses derived from where a camera stands and looks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.transforms_json import read_transforms
from mvseg.scene import Scene
from warned import warns_of

CENTERS = np.array([[3.0, 0.5, 4.0], [-2.0, 1.0, 5.0], [0.5, 2.0, 4.5]])
POINTS = np.array([[0.3, 0.2, 0.1], [-0.5, 0.4, 0.6], [0.0, 0.0, 0.0], [0.2, -0.7, -0.4]])
INTRINSICS = {"w": 200, "h": 120, "fl_x": 150.0, "fl_y": 160.0, "cx": 101.0, "cy": 61.0}


def opengl_pose(center: np.ndarray) -> np.ndarray:
    """(4, 4) world_from_cam: columns are the camera's right, up and backward axes in the world, and its centre; it
    looks at the origin and +y of the world is up."""
    backward = center / np.linalg.norm(center)
    right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack((right, np.cross(backward, right), backward, center), 1)
    return pose


def transforms() -> dict[str, Any]:
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": opengl_pose(center).tolist()}
        for name, center in zip("abc", CENTERS, strict=True)
    ]
    return {"camera_model": "OPENCV", **INTRINSICS, "frames": frames}


def read(folder: Path, content: dict[str, Any]) -> Scene:
    (folder / "transforms.json").write_text(json.dumps(content))
    return read_transforms(folder / "transforms.json")


def expected_px(center: np.ndarray) -> np.ndarray:
    """Right of the axis is right in the image, up is up (v falls), by the distance along the viewing direction."""
    pose = opengl_pose(center)
    right, up, backward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    offset = POINTS - center
    depth = -offset @ backward
    return np.stack((101 + 150 * (offset @ right) / depth, 61 - 160 * (offset @ up) / depth), 1)


def test_axes(tmp_path: Path) -> None:
    scene = read(tmp_path, transforms())
    px, depth = scene.cameras.project(torch.from_numpy(POINTS))
    for view, center in enumerate(CENTERS):
        np.testing.assert_allclose(px[view], expected_px(center), atol=1e-9)
        np.testing.assert_allclose(depth[view, 2], np.linalg.norm(center))
    np.testing.assert_allclose(scene.cameras.centers, CENTERS, atol=1e-12)
    np.testing.assert_allclose(px[:, 2], [[101, 61]] * 3, atol=1e-9)  # all look at the origin
    assert [view.name for view in scene.views] == ["a", "b", "c"]
    assert scene.unit == ""


def test_three_rows_are_as_good_as_four(tmp_path: Path) -> None:
    content = transforms()
    whole = read(tmp_path, content).cameras
    for frame in content["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    assert torch.equal(read(tmp_path, content).cameras.t, whole.t)


def test_intrinsics_of_frames_go_first_and_one_focal_length_serves_both_axes(tmp_path: Path) -> None:
    content = transforms()
    content["frames"][1] |= {"fl_x": 99.0, "fl_y": 98.0, "w": 220, "k1": 0.1}
    cameras = (scene := read(tmp_path, content)).cameras
    assert cameras.K[:, 0, 0].tolist() == [150, 99, 150]
    assert cameras.K[:, 1, 1].tolist() == [160, 98, 160]
    assert cameras.K[1, :2, 2].tolist() == [101, 61]
    assert cameras.sizes.tolist() == [[200, 120], [220, 120], [200, 120]]
    assert [view.lens is None for view in scene.views] == [True, False, True]
    content = transforms()
    content["frames"] = [frame | INTRINSICS for frame in content["frames"]]
    for key in INTRINSICS:
        del content[key]
    assert read(tmp_path, content).cameras.K[2, 1, 1] == 160
    content = transforms()
    del content["fl_y"]
    assert read(tmp_path, content).cameras.K[0].diagonal().tolist() == [150, 150, 1]


def test_distortion_agrees_with_opencv(tmp_path: Path) -> None:
    content = transforms() | {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.003}
    scene = read(tmp_path, content)
    px, _ = scene.cameras.project(torch.from_numpy(POINTS))
    K = np.array([[150, 0, 100.5], [0, 160, 60.5], [0, 0, 1]])
    for view in range(3):
        R, t = scene.cameras.R[view].numpy(), scene.cameras.t[view].numpy()
        coefficients = np.array([-0.1, 0.02, 0.001, -0.002, 0.003])
        expected, _ = cv2.projectPoints(POINTS, cv2.Rodrigues(R)[0], t, K, coefficients)
        found = photo_from_pinhole(scene.views[view].lens, scene.cameras.K[view].numpy(), px[view].numpy())
        np.testing.assert_allclose(found - 0.5, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize(("k1", "k3"), [(0.0, 0.002), (0.05, 0.0)])
def test_fisheye_agrees_with_opencv(k1: float, k3: float, tmp_path: Path) -> None:
    lens = {"k1": k1, "k2": -0.01, "k4": 0.001} | ({"k3": k3} if k3 else {})
    scene = read(tmp_path, transforms() | {"camera_model": "OPENCV_FISHEYE"} | lens)
    px, _ = scene.cameras.project(torch.from_numpy(POINTS))
    K = np.array([[150, 0, 101.0], [0, 160, 61.0], [0, 0, 1]])
    for view in range(3):
        R, t = scene.cameras.R[view].numpy(), scene.cameras.t[view].numpy()
        expected, _ = cv2.fisheye.projectPoints(
            POINTS[:, None], cv2.Rodrigues(R)[0], t, K, np.array([k1, -0.01, k3, 0.001])
        )
        found = photo_from_pinhole(scene.views[view].lens, scene.cameras.K[view].numpy(), px[view].numpy())
        np.testing.assert_allclose(found, expected[:, 0], atol=1e-9)


def test_missing_suffix_is_looked_for(tmp_path: Path) -> None:
    content = transforms()
    content["frames"][0]["file_path"] = "./images/a"
    content["frames"][1]["file_path"] = "images/frame.0001"
    content["frames"][2]["file_path"] = "images/nowhere"
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").touch()
    (tmp_path / "images" / "frame.0001.jpg").touch()
    scene = read(tmp_path, content)
    assert [view.path.name for view in scene.views] == ["a.png", "frame.0001.jpg", "nowhere"]
    assert [view.name for view in scene.views] == ["a", "frame.0001", "nowhere"]


BAD: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"frames": []}, {}, "there are no views"),
    ({"fl_x": None}, {}, r"frame 0 \(images/a.png\): 'fl_x' is missing"),
    ({"w": None}, {}, r"frame 0 \(images/a.png\): width and height are missing, and so is the photo"),
    ({"w": 10**30}, {}, "w: Input should be less than or equal to"),
    ({"camera_model": "CUBIST"}, {}, r"frame 0 .*: the camera model 'CUBIST' is not known, expected OPENCV"),
    ({}, {"camera_model": "EQUIRECTANGULAR"}, r"frame 1 \(images/b.png\): the camera model 'EQUIRECTANGULAR' is not"),
    ({"k4": 0.1}, {}, "frame 0 .*: k4 is 0.1"),
    ({}, {"file_path": "../b.png"}, "view 1 .*: the file name leads out of the scene folder"),
    ({}, {"file_path": "images/a.jpg"}, "views 0 and 1 have the same name 'a'"),
    ({}, {"transform_matrix": [[1, 0, 0, 0]] * 2}, r"frames\[1\]\.transform_matrix"),
    ({}, {"transform_matrix": [[1, 0, 0, float("nan")], *np.eye(4)[1:].tolist()]}, r"frames\[1\]\.transform_matrix"),
    ({}, {"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "view 1 .*: R is a reflection"),
    ({}, {"transform_matrix": np.diag([1, 1, 1, 2]).tolist()}, "frame 1 .*: the last row of transform_matrix is not"),
]


@pytest.mark.parametrize(("top", "frame", "message"), BAD)
def test_bad_files_are_named(top: dict[str, Any], frame: dict[str, Any], message: str, tmp_path: Path) -> None:
    content = transforms()
    content["frames"][1] |= frame
    with pytest.raises(InputError, match=rf"transforms.json: {message}"):
        read(tmp_path, content | top)


def write_photos(folder: Path, width: int = 200, height: int = 120) -> None:
    (folder / "images").mkdir()
    for name in "abc":
        Image.new("RGB", (width, height)).save(folder / "images" / f"{name}.png")


def test_instant_ngps_fisheye_is_opencvs(tmp_path: Path) -> None:
    content = transforms() | {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.001}
    (expected, *_) = read(tmp_path, content | {"camera_model": "OPENCV_FISHEYE"}).views
    del content["camera_model"]
    (found, *_) = read(tmp_path, content | {"is_fisheye": True, "aabb_scale": 4}).views
    assert (found.lens.model_name, list(found.lens.params)) == ("OPENCV_FISHEYE", list(expected.lens.params))
    assert read(tmp_path, content | {"is_fisheye": False, "k4": 0.0}).views[0].lens.model_name == "FULL_OPENCV"


@pytest.mark.parametrize("key", ["ftheta_p0", "latlong", "equirectangular"])
def test_other_lenses_of_instant_ngp_are_refused(key: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"transforms.json: '{key}' of the file is 1.5, which is not supported"):
        read(tmp_path, transforms() | {key: 1.5})


def test_what_nerfstudio_applied_is_undone(tmp_path: Path) -> None:
    """Its ns-process-data swaps y and z; here with a shift and a scale, too. Points and cameras move together, so the
    original points have the original pixels."""
    applied = np.array([[1.0, 0, 0, 3], [0, 0, 1, -2], [0, -1, 0, 5]])
    content = transforms()
    expected = read(tmp_path, content).cameras
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        moved = np.eye(4)
        moved[:3, :3] = applied[:, :3] @ pose[:3, :3]
        moved[:3, 3] = 0.25 * (applied[:, :3] @ pose[:3, 3] + applied[:, 3])
        frame["transform_matrix"] = moved.tolist()
    cameras = read(tmp_path, content | {"applied_transform": applied.tolist(), "applied_scale": 0.25}).cameras
    np.testing.assert_allclose(cameras.R, expected.R, atol=1e-12)
    np.testing.assert_allclose(cameras.t, expected.t, atol=1e-12)
    np.testing.assert_allclose(cameras.project(torch.from_numpy(POINTS))[0][0], expected_px(CENTERS[0]), atol=1e-9)


@pytest.mark.parametrize("applied", [np.diag([2.0, 2, 2, 1]), np.diag([1.0, 1, -1, 1])])
def test_an_applied_transform_that_bends(applied: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="applied_transform is not a rotation with a translation"):
        read(tmp_path, transforms() | {"applied_transform": applied.tolist()})
    with pytest.raises(InputError, match=r"transforms.json: applied_scale: Input should be greater than 0"):
        read(tmp_path, transforms() | {"applied_scale": 0})


def test_masks_of_nerfstudio_are_named(tmp_path: Path) -> None:
    content = transforms()
    content["frames"][1]["mask_path"] = "masks/b.png"
    with warns_of("mask_paths_not_used"):
        read(tmp_path, content)


def test_blenders_angle_of_view_and_the_size_of_the_photos(tmp_path: Path) -> None:
    """As the NeRF paper's scenes: names without suffix, a focal length of half the width over tan of half the angle,
    and the principal point in the middle."""
    write_photos(tmp_path)
    frames = [frame | {"file_path": f"./images/{name}", "rotation": 0.01}
              for name, frame in zip("abc", transforms()["frames"], strict=True)]  # fmt: skip
    scene = read(tmp_path, {"camera_angle_x": 2 * np.arctan(100 / 150.0), "frames": frames})
    assert scene.cameras.sizes.tolist() == [[200, 120]] * 3
    np.testing.assert_allclose(scene.cameras.K[0], [[150, 0, 100], [0, 150, 60], [0, 0, 1]], atol=1e-12)
    center = scene.cameras.project(torch.zeros(1, 3))[0]
    np.testing.assert_allclose(center[:, 0], [[100, 60]] * 3, atol=1e-9)  # all look at the origin
    assert [view.path.name for view in scene.views] == ["a.png", "b.png", "c.png"]
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert torch.equal(load_scene(tmp_path).cameras.K, scene.cameras.K)
    with pytest.raises(InputError, match=r"camera_angle_x: Input should be less than"):
        read(tmp_path, {"camera_angle_x": 4, "frames": frames})
    (tmp_path / "images" / "b.png").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"frame 1 \(./images/b\): width and height are missing, and the photo"):
        read(tmp_path, {"camera_angle_x": 1.0, "frames": frames})


def test_paths_of_another_machine(tmp_path: Path) -> None:
    write_photos(tmp_path)
    content = transforms()
    for name, frame in zip("abc", content["frames"], strict=True):
        frame["file_path"] = f"/home/me/plant/photos/{name.upper()}.png"
    with warns_of("photos_by_name"):
        scene = read(tmp_path, content)
    assert [view.name for view in scene.views] == ["a", "b", "c"]
    assert all(view.path.is_file() for view in scene.views)
    for place in ("../photos\\", "./../../data/", "..\\..\\"):  # colmap2nerf's, from where it ran
        for name, frame in zip("abc", content["frames"], strict=True):
            frame["file_path"] = f"{place}{name}.png"
        del content["w"], content["h"]
        with warns_of("photos_by_name"):
            scene = read(tmp_path, content)
        assert all(view.path.is_file() for view in scene.views)
        content |= {"w": 200, "h": 120}
    content["frames"][2]["file_path"] = "/home/me/d.png"
    with pytest.raises(InputError, match=r"view 2 \(/home/me/d.png\): the file name leads out of the scene folder"):
        read(tmp_path, content)
