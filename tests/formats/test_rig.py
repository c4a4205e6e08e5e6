"""The rig file against OpenCV, there and back, and every way to get it wrong."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError, InputWarning
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.rig import read_rig, write_rig
from mvseg.scene import Scene
from scene_folders import BALLS, arc_pose, edit_rig, rig_content, write_scene

DISTORTION = [-0.2, 0.05, 0.001, -0.002, 0.01]


def write(folder: Path, content: Any) -> Path:
    path = folder / "cameras.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def read(folder: Path, content: Any) -> Scene:
    return read_rig(write(folder, content))


def test_distorted_photo_positions_agree_with_opencv(tmp_path: Path) -> None:
    rig = rig_content()
    rig["views"][2]["distortion"] = DISTORTION
    scene = read(tmp_path, rig)
    lens, K = scene.views[2].lens, scene.cameras.K[2].numpy()
    assert lens is not None
    assert [view.lens is None for view in scene.views] == [True, True, False, True]
    R, t = arc_pose(2, 4)
    zero_centred = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    expected, _ = cv2.projectPoints(BALLS, cv2.Rodrigues(R)[0], t, zero_centred, np.array(DISTORTION))
    px, _ = scene.cameras.project(torch.from_numpy(BALLS))
    np.testing.assert_allclose(photo_from_pinhole(lens, K, px[2].numpy()) - 0.5, expected[:, 0], atol=1e-9)


def test_round_trip(tmp_path: Path) -> None:
    rig = rig_content()
    rig["views"][1]["distortion"] = DISTORTION
    scene = read(tmp_path, rig)
    files = [entry["file"] for entry in rig["views"]]
    write_rig(tmp_path / "again.json", scene, files)
    assert json.loads((tmp_path / "again.json").read_text()) == rig
    again = read_rig(tmp_path / "again.json")
    assert again.unit == "mm"
    for field in ("K", "R", "t", "sizes"):
        assert torch.equal(getattr(again.cameras, field), getattr(scene.cameras, field))
    assert again.views[1].lens is not None
    assert list(again.views[1].lens.params) == list(scene.views[1].lens.params)  # type: ignore[union-attr]


def test_zero_distortion_no_unit_and_a_byte_order_mark_are_no_faults(tmp_path: Path) -> None:
    rig = rig_content()
    rig["views"][0]["distortion"] = [0, 0, 0, 0, 0]
    rig["views"][1]["distortion"] = []
    rig["views"][2]["distortion"] = None
    assert all(view.lens is None for view in read(tmp_path, rig).views)
    rig = rig_content()
    del rig["unit"]
    assert read(tmp_path, rig).unit == ""
    (tmp_path / "cameras.json").write_text(json.dumps(rig_content()), encoding="utf-8-sig")
    assert len(read_rig(tmp_path / "cameras.json").views) == 4


def test_unknown_keys_are_warned_of(tmp_path: Path) -> None:
    rig = rig_content() | {"author": "me"}
    rig["views"][3]["distorsion"] = DISTORTION
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = read(tmp_path, rig)
    assert scene.views[3].lens is None
    assert all(one.category is InputWarning for one in caught)
    found = [str(one.message).split(": ", 1)[1] for one in caught]
    assert found == ["unknown key 'author' of the rig is ignored", "unknown key 'distorsion' of view 3 is ignored"]


BAD_RIGS: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"format": "mvseg-rig/2"}, {}, "format: Input should be 'mvseg-rig/1'"),
    ({"format": None}, {}, "format: Input should be"),
    ({"views": []}, {}, "there are no views"),
    ({"views": None}, {}, "views: Input should be a valid list"),
    ({}, {"R": np.diag([1.0, -1.0, 1.0]).tolist()}, r"view 1 \(images/001.png\): R is a reflection"),
    ({}, {"R": np.diag([1.0, 1.1, 1.0]).tolist()}, r"view 1 \(images/001.png\): R is not a rotation"),
    ({}, {"t": [0, float("nan"), 0]}, r"views\[1\]\.t\[1\]: Input should be a finite number"),
    ({}, {"t": [0, 0]}, r"views\[1\]\.t\[2\]: Field required"),
    ({}, {"t": [0, 0, "up"]}, r"views\[1\]\.t\[2\]: Input should be a valid number"),
    ({}, {"K": [[0, 0, 64], [0, 150, 48], [0, 0, 1]]}, "view 1 .*: the focal length is 0, 150"),
    ({}, {"K": [[150, 0, 0], [0, 150, 0], [64, 48, 1]]}, "view 1 .*: K is not upper triangular"),
    ({}, {"width": 0}, r"views\[1\]\.width: Input should be greater than or equal to 1"),
    ({}, {"width": 10**30}, r"views\[1\]\.width: Input should be less than or equal to"),
    ({}, {"height": 95.5}, r"views\[1\]\.height: Input should be a valid integer"),
    ({}, {"file": "images/000.jpg"}, "views 0 and 1 have the same name '000'"),
    ({}, {"file": "../001.png"}, r"view 1 \(\.\./001.png\): the file name leads out of the scene folder"),
    ({}, {"distortion": [0.1, 0.2]}, r"view 1 \(images/001.png\): distortion has 2 numbers, expected k1, k2, p1, p2"),
    ({}, {"distortion": [0.1, 0, 0, float("nan")]}, r"views\[1\]\.distortion\[3\]: Input should be a finite number"),
    ({}, {"distortion": [0.1, 0, 0, 0], "K": [[150, 2, 64], [0, 150, 48], [0, 0, 1]]}, "view 1 .*: K has skew"),
]


@pytest.mark.parametrize(("top", "view", "message"), BAD_RIGS)
def test_bad_rigs_are_named(top: dict[str, Any], view: dict[str, Any], message: str, tmp_path: Path) -> None:
    rig = rig_content()
    rig["views"][1] |= view
    with pytest.raises(InputError, match=rf"cameras.json: {message}"):
        read(tmp_path, rig | top)


CUT = [b"", b"{", b"nonsense", b'{"format": "mvseg-rig/1", "views": [{"fi', b"[" * 99999, b"9" * 9999, b"\xff\xfe\x80"]


@pytest.mark.parametrize("content", CUT, ids=lambda content: str(content[:20]))
def test_broken_json(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_bytes(content)
    with pytest.raises(InputError, match=r"cameras.json: not a whole JSON file"):
        read_rig(tmp_path / "cameras.json")


@pytest.mark.parametrize("content", ["[]", "null", "3", "{}"])
def test_other_json(content: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(InputError, match=r"cameras.json: (format: Field required|Input should be)"):
        read_rig(tmp_path / "cameras.json")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cameras.json: cannot be read"):
        read_rig(tmp_path / "cameras.json")


def test_sizes_come_from_the_photos(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    expected = read_rig(folder / "cameras.json").cameras.sizes
    rig = json.loads((folder / "cameras.json").read_text())
    for view in rig["views"]:
        del view["width"], view["height"]
    (folder / "cameras.json").write_text(json.dumps(rig))
    assert torch.equal(read_rig(folder / "cameras.json").cameras.sizes, expected)
    (folder / "images" / "002.png").unlink()
    with pytest.raises(InputError, match=r"view 2 \(images/002.png\): width and height are missing, and so is"):
        read_rig(folder / "cameras.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": None}, "expected either K or a calibration file"),
        ({"calibration": "a.yaml"}, "expected either K or a calibration file"),
        ({"K": None, "calibration": "../a.yaml"}, "../a.yaml: the file name leads out of the scene folder"),
        ({"K": None, "calibration": "absent.yaml"}, "absent.yaml: cannot be read"),
        ({"K": None, "calibration": "a.yaml", "distortion": [0.1, 0, 0, 0]}, "distortion beside a calibration file"),
        ({"K": None, "calibration": "a.yaml"}, "the calibration is of 640 x 480 pixels, the camera says 128 x 96"),
    ],
)
def test_calibrations_that_do_not_fit(change: dict[str, object], message: str, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    text = "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [700, 0, 320, 0, 700, 240, 0, 0, 1]}\n"
    (folder / "a.yaml").write_text(text)
    edit_rig(folder, 1, **change)
    with pytest.raises(InputError, match=rf"cameras.json: view 1 \(images/001.png\): .*{message}"):
        read_rig(folder / "cameras.json")
