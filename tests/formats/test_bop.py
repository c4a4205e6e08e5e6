"""BOP's scene_camera.json, as its toolkit writes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import HEIGHT, WIDTH, arc_pose, write_image

CAM_K = np.array([[150.0, 0, 63.25], [0, 151, 47.5], [0, 0, 1]])
POINTS = np.random.default_rng(1).uniform(-8, 8, (10, 3))


def write(folder: Path, *, suffix: str = "png", place: str = "rgb") -> dict[str, Any]:
    content: dict[str, Any] = {}
    numbers = (0, 3, 12)
    for index, number in enumerate(numbers):
        R, t = arc_pose(index, len(numbers))
        pose = {"cam_R_w2c": R.ravel().tolist(), "cam_t_w2c": t.tolist()}
        content[str(number)] = {"cam_K": CAM_K.ravel().tolist(), **pose, "depth_scale": 0.1}
        write_image(folder / place / f"{number:06d}.{suffix}", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    (folder / "scene_camera.json").write_text(json.dumps(content))
    return content


@pytest.mark.parametrize(("place", "suffix"), [("rgb", "png"), ("rgb", "jpg"), ("gray", "tif")])
def test_projections_agree_with_opencv(place: str, suffix: str, tmp_path: Path) -> None:
    write(tmp_path, suffix=suffix, place=place)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == ["000000", "000003", "000012"]
    assert scene.cameras.sizes.tolist() == [[WIDTH, HEIGHT]] * 3
    assert scene.unit == "mm"
    px, _ = scene.cameras.project(torch.from_numpy(POINTS))
    for view in range(3):
        R, t = arc_pose(view, 3)
        expected, _ = cv2.projectPoints(POINTS, cv2.Rodrigues(R)[0], t, CAM_K, None)
        np.testing.assert_allclose(px[view], expected[:, 0] + 0.5, atol=1e-9)


def test_masks_of_bop(tmp_path: Path) -> None:
    write(tmp_path)
    for number in (0, 3, 12):
        for instance in range(2):
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[10:20, 30 * instance : 30 * instance + 20] = 255
            write_image(tmp_path / "mask_visib" / f"{number:06d}_{instance:06d}.png", mask)
    assert load_masks(load_scene(tmp_path), tmp_path / "mask_visib").num_per_view.tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cam_R_w2c": None}, "image 3 has no cam_R_w2c or cam_t_w2c, expected the pose of each camera"),
        ({"cam_K": [1.0] * 8}, "3.cam_K: List should have at least 9 items"),
        ({"cam_R_w2c": [2.0, 0, 0, 0, 2, 0, 0, 0, 2]}, "view 1 .*: R is not a rotation"),
    ],
)
def test_bad_files_are_named(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    content = write(tmp_path)
    content["3"] |= change
    (tmp_path / "scene_camera.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=rf"scene_camera.json: {message}"):
        load_scene(tmp_path)


def test_a_photo_tells_the_size(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "rgb" / "000003.png").unlink()
    with pytest.raises(InputError, match=r"image 3 \(rgb/000003.png\): width and height are missing"):
        load_scene(tmp_path)
