"""Turntables: points whose pixels are known, the law of turns, and a rig of four cameras and twelve angles."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mvseg.errors import InputError
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.turntable import read_turntable
from mvseg.scene import Scene
from scene_folders import HEIGHT, WIDTH, K, arc_pose
from warned import warns_of

# It looks at the axis from 500 mm in front, along +y of the world; +z of the world is up.
FRONT = {"R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "t": [0, 0, 500]}
CAMERA = {"width": WIDTH, "height": HEIGHT, "K": [[100, 0, 64], [0, 100, 48], [0, 0, 1]], **FRONT}


def table(*angles: float, **changes: Any) -> dict[str, Any]:
    views = [{"file": f"images/{number}.jpg", "camera": "front", "angle": angle} for number, angle in enumerate(angles)]
    axis = {"point": [0, 0, 0], "direction": [0, 0, 2]}
    content = {"format": "mvseg-turntable/1", "unit": "mm", "axis": axis, "cameras": {"front": CAMERA}, "views": views}
    return copy.deepcopy(content | changes)


def read(folder: Path, content: dict[str, Any]) -> Scene:
    (folder / "turntable.json").write_text(json.dumps(content))
    return read_turntable(folder / "turntable.json")


def test_known_pixels(tmp_path: Path) -> None:
    """A leaf 100 mm to the right and 50 mm up. Anticlockwise from above, a quarter of a turn takes it to the far side,
    half a turn to the left, three quarters to the near side."""
    scene = read(tmp_path, table(0, 90, 180, 270, -90, 360))
    px, depth = scene.cameras.project(torch.tensor([[100.0, 0, 50]]))
    expected = [[84, 38], [64, 48 - 100 * 50 / 600], [44, 38], [64, 48 - 100 * 50 / 400], [64, 35.5], [84, 38]]
    np.testing.assert_allclose(px[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(depth[:, 0], [500, 600, 500, 400, 400, 500], atol=1e-9)
    assert (scene.unit, scene.views[0].name) == ("mm", "0")


def test_an_axis_anywhere(tmp_path: Path) -> None:
    """Turning the plant is turning its points about the axis: the fixed camera sees the turned points."""
    point, direction = np.array([30.0, -20, 5]), np.array([0.2, -0.3, 1])
    axis = {"point": point.tolist(), "direction": direction.tolist()}
    points = np.random.default_rng(0).uniform(-50, 50, (9, 3))
    angles = (0.0, 37.0, 200.0)
    cameras = read(tmp_path, table(*angles, axis=axis)).cameras
    px, _ = cameras.project(torch.from_numpy(points))
    for view, angle in enumerate(angles):
        turn = Rotation.from_rotvec(direction / np.linalg.norm(direction) * np.radians(angle))
        turned = turn.apply(points - point) + point
        np.testing.assert_allclose(px[view], cameras.project(torch.from_numpy(turned))[0][0], atol=1e-9)
    on_axis = torch.from_numpy(point + np.outer([-40.0, 40], direction))
    np.testing.assert_allclose(cameras.project(on_axis)[0], np.stack([cameras.project(on_axis)[0][0]] * 3), atol=1e-9)


@pytest.mark.parametrize("length", [1e-300, 1e-3, 1e300])
def test_the_length_of_the_axis_does_not_matter(length: float, tmp_path: Path) -> None:
    axis = {"point": [3, -2, 1], "direction": [length, 0, -length]}
    other = axis | {"direction": [1, 0, -1]}
    path = tmp_path / "turntable.json"
    path.write_text(json.dumps(table(0, 40, axis=other)))
    expected = read_turntable(path).cameras
    path.write_text(json.dumps(table(0, 40, axis=axis)))
    torch.testing.assert_close(read_turntable(path).cameras.R, expected.R)
    torch.testing.assert_close(read_turntable(path).cameras.t, expected.t)


def test_four_cameras_and_twelve_angles(tmp_path: Path) -> None:
    """One of them by its calibration file, one with a lens; sizes where they are given."""
    cameras: dict[str, Any] = {}
    for number in range(4):
        R, t = arc_pose(number, 4)
        cameras[f"c{number}"] = {"width": WIDTH, "height": HEIGHT, "K": K.tolist(), "R": R.tolist(), "t": t.tolist()}
    cameras["c1"]["distortion"] = [-0.1, 0.01, 0, 0, 0]
    del cameras["c2"]["K"]
    cameras["c2"]["calibration"] = "c2.yaml"
    data = (K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).ravel().tolist()
    (tmp_path / "c2.yaml").write_text(f"%YAML:1.0\n---\ncamera_matrix: {{rows: 3, cols: 3, data: {data}}}\n")
    views = [
        {"file": f"images/{name}/{angle:03d}.jpg", "camera": name, "angle": angle}
        for name in cameras
        for angle in range(0, 360, 30)
    ]
    (tmp_path / "turntable.json").write_text(json.dumps(table(cameras=cameras, views=views)))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 48
    assert (scene.views[13].name, scene.source) == ("c1/030", tmp_path / "turntable.json")
    assert [view.lens is not None for view in scene.views] == [False] * 12 + [True] * 12 + [False] * 24
    np.testing.assert_allclose(scene.cameras.K, np.broadcast_to(K, (48, 3, 3)), atol=1e-12)
    centers = scene.cameras.centers.reshape(4, 12, 3)
    np.testing.assert_allclose(centers[..., 2], centers[:, :1, 2].expand(4, 12), atol=1e-9)  # circles about the axis
    radii = centers[..., :2].norm(dim=-1)
    np.testing.assert_allclose(radii, radii[:, :1].expand(4, 12), atol=1e-9)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"format": "mvseg-rig/1"}, "format: Input should be 'mvseg-turntable/1'"),
    ({"axis": {"point": [0, 0, 0], "direction": [0, 0, 0]}}, "the direction of the axis is 0, 0, 0"),
    ({"axis": {"direction": [0, 0, 1]}}, "axis.point: Field required"),
    ({"axis": {"point": [0, 0, 0], "direction": [0, 0, float("nan")]}}, r"axis.direction\[2\]: Input"),
    ({"cameras": {}}, r"view 0 \(images/0.jpg\): there is no camera 'front'"),
    ({"cameras": {"front": CAMERA | {"K": None}}}, r"view 0 \(images/0.jpg\): expected either K or a calibration"),
    ({"cameras": {"front": CAMERA | {"R": np.diag([1, 1, -1]).tolist()}}}, r"view 0 .*: R is a reflection"),
    ({"views": []}, "there are no views"),
    ({"views": [{"file": "../a.jpg", "camera": "front", "angle": 0}] * 2}, "view 0 .*: the file name leads out"),
    ({"views": [{"file": "a.jpg", "camera": "front", "angle": 0}] * 2}, "views 0 and 1 have the same name"),
    ({"views": [{"file": "a.jpg", "camera": "front"}]}, r"views\[0\].angle: Field required"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_bad_files_are_named(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"turntable.json: {message}"):
        read(tmp_path, table(0, 90) | change)


def test_unknown_keys_are_named(tmp_path: Path) -> None:
    content = table(0, 90)
    content["cameras"]["front"]["distorsion"] = [1, 2, 3, 4]
    with warns_of("unknown_key"):
        read(tmp_path, content)
