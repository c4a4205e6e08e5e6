"""`mvseg pose --turntable`: the table calibrated from a rendered board, and then used for other photos."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from mvseg.cli import main
from mvseg.formats.image_file import write_png
from mvseg.formats.markers import find_board
from mvseg.formats.photos import read_photo
from mvseg.formats.scene_folder import load_scene
from mvseg.reconstruction.triangulate import triangulate_points
from room_scene import BOARD
from turntable_board import ANGLES, HEIGHT, SIDE_R, SIDE_T, WIDTH, K, draw_board

OPTIONS = ["--board.columns", "5", "--board.rows", "4", "--board.square", "40", "--board.marker", "30", "--quiet"]


def write_photos(folder: Path, photos: list[np.ndarray]) -> Path:
    folder.mkdir()
    for index, photo in enumerate(photos):
        write_png(folder / f"{index}.png", np.repeat(photo[..., None], 3, 2))
    return folder


def test_a_table_is_calibrated_once_and_serves_other_photos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = np.full((HEIGHT, WIDTH), 90, np.uint8)
    photos = write_photos(tmp_path / "photos", [*(draw_board(angle) for angle in ANGLES), empty])
    table = tmp_path / "table"
    command = ["pose", str(photos), "--out", str(table), "--turntable", "board", "--unit", "mm", *OPTIONS]
    assert main(command) == 0
    scene = load_scene(table)
    assert scene.unit == "mm"
    assert [view.name for view in scene.views] == [str(view) for view in range(len(ANGLES))]  # not the empty one
    # The board stands on the table: its corners are triangulated as large as they were printed.
    seen: dict[int, list] = {}
    for view in range(len(scene.views)):
        for number, px in zip(*find_board(read_photo(scene, view)[..., 0].copy(), BOARD), strict=True):
            seen.setdefault(int(number), []).append((view, px))
    points = triangulate_points(scene.cameras, seen)
    found, printed = np.array(list(points.values())), BOARD.corners()[list(points)]
    assert len(points) == 12
    np.testing.assert_allclose(torch.pdist(torch.tensor(found)), torch.pdist(torch.tensor(printed)), atol=0.3)  # mm

    (photos / f"{len(ANGLES)}.png").unlink()
    plant = tmp_path / "plant"
    again = ["pose", str(photos), "--out", str(plant), "--turntable", str(table / "turntable.json")]
    assert main([*again, "--quiet"]) == 0
    same = load_scene(plant)
    torch.testing.assert_close(same.cameras.t, scene.cameras.t)
    assert (same.unit, len(same.views)) == ("mm", len(ANGLES))
    assert capsys.readouterr().err == ""
    assert json.loads((table / "pose.json").read_text())["registered"] == [f"{view}.png" for view in range(len(ANGLES))]

    (photos / "7.png").unlink()
    assert main(again) == 2
    said = "8 views for 7 photos, expected one per photo, in the order of their names, or --angles"
    assert said in capsys.readouterr().err
    write_png(photos / "7.png", np.zeros((20, 30, 3), np.uint8))
    assert main([*again, "--quiet"]) == 2
    assert "7.png has 30 x 20 pixels, the turntable's camera 640 x 480" in capsys.readouterr().err
    assert len(load_scene(plant).views) == 8  # the earlier scene is still there
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "plant", "table"]


def test_an_unsure_focal_length_is_warned_of_and_a_given_one_is_sure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = Rotation.from_euler("z", 20, degrees=True)
    photos = write_photos(tmp_path / "photos", [draw_board(angle, tilt=flat) for angle in ANGLES[::2]])
    command = ["pose", str(photos), "--out", str(tmp_path / "table"), "--turntable", "board", *OPTIONS]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert re.search(r"camera: focal length 69\d \+- \d.* px \(1.\d%\): .* as uncertain; photograph the board", said)
    written = json.loads((tmp_path / "table" / "pose.json").read_text())
    assert 7 < written["lenses"][0]["focal_length"]["deviation"] < 14
    assert [each["code"] for each in written["findings"]] == ["turntable_focal_length_unsure"]

    lens = tmp_path / "lens.yaml"
    matrix = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # OpenCV's first pixel has its centre at (0, 0)
    lens.write_text(yaml.safe_dump({"K": matrix.tolist(), "D": [0.0] * 5}))
    assert main([*command, "--calibration", str(lens)]) == 0
    assert capsys.readouterr().err == ""
    written = json.loads((tmp_path / "table" / "turntable.json").read_text())
    np.testing.assert_allclose(written["cameras"]["camera"]["K"], K)
    lens.write_text(yaml.safe_dump({"K": K.tolist(), "D": [0.1] * 8}))
    assert main([*command, "--calibration", str(lens)]) == 2
    assert "lens.yaml: expected K without skew and k1, k2, p1, p2, k3" in capsys.readouterr().err


@pytest.mark.slow
def test_two_cameras_and_other_angles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos, table = tmp_path / "photos", tmp_path / "table"
    photos.mkdir()
    write_photos(photos / "top", [draw_board(angle) for angle in ANGLES])
    write_photos(photos / "side", [draw_board(angle, pose=(SIDE_R, SIDE_T)) for angle in ANGLES])
    assert main(["pose", str(photos), "--out", str(table), "--turntable", "board", "--unit", "mm", *OPTIONS]) == 0
    assert len(load_scene(table).views) == 2 * len(ANGLES)
    written = json.loads((table / "turntable.json").read_text())
    assert sorted(written["cameras"]) == ["side", "top"]

    again = ["pose", str(photos), "--out", str(tmp_path / "plant"), "--turntable", str(table / "turntable.json")]
    (photos / "side" / "7.png").unlink()
    assert main([*again, "--quiet"]) == 2
    assert "8 views of camera side for 7 photos" in capsys.readouterr().err
    log = tmp_path / "angles.csv"
    lines = [f"top/{index}.png,{10 * index}" for index in range(8)]
    lines += [f"side/{index}.png,{10 * index + 5}" for index in range(7)]
    log.write_text("\n".join(["photo,angle", *lines]))
    for angles, expected in ((["--angles", str(log)], [5, 15]), (["--angles=-7.5"], [0, -7.5])):
        assert main([*again, "--quiet", *angles]) == 0
        views = json.loads((tmp_path / "plant" / "turntable.json").read_text())["views"]
        assert [view["angle"] for view in views if view["camera"] == "side"][:2] == expected
        assert len(load_scene(tmp_path / "plant").views) == 15
    log.write_text("photo,angle\ntop/0.png,0")
    assert main([*again, "--quiet", "--angles", str(log)]) == 2
    assert "there is no angle of photo" in capsys.readouterr().err
    (photos / "side").rename(photos / "other")
    assert main([*again, "--quiet", "--angles", "10"]) == 2
    assert "other/0.png is in no folder of a camera, expected folders of these names" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--angles", "10"], "--angles has no effect without --turntable and a turntable.json"),
        (["--turntable", "board"], "needs the board"),
        (["--turntable", "board", "--marker", "30"], "marker: no effect with --turntable board"),
        (["--turntable", "t.json", "--unit", "mm", "--up", "rig"], "unit, up: no effect with --turntable t.json"),
        (["--turntable", "board", *OPTIONS, "--image_size", "800"], "the options of structure from motion: no effect"),
        (["--turntable", "nowhere.json"], "nowhere.json: cannot be read"),
    ],
)
def test_wrong_options(tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    photos = write_photos(tmp_path / "photos", [np.zeros((20, 30), np.uint8)] * 4)
    assert main(["pose", str(photos), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axis": {"point": [1, 0, 0], "direction": [0, 0, 1]}}, "the axis 0 0 1 at 0 0 0"),
        ({"cameras": {"camera": {"calibration": "c.yaml", "R": np.eye(3).tolist(), "t": [0, 0, 1]}}}, "has no K"),
        ({"views": [{"file": "0.png", "camera": "top", "angle": 0}]}, "there is no camera 'top'"),
    ],
)
def test_turntables_of_others(tmp_path: Path, capsys: pytest.CaptureFixture[str], change, message: str) -> None:
    photos = write_photos(tmp_path / "photos", [np.zeros((20, 30), np.uint8)] * 3)
    camera = {"width": 30, "height": 20, "K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 1]}
    content = {"format": "mvseg-turntable/1", "axis": {"point": [0, 0, 0], "direction": [0, 0, 1]},
               "cameras": {"camera": camera}, "views": []}  # fmt: skip
    (tmp_path / "turntable.json").write_text(json.dumps(content | change))
    options = ["--turntable", str(tmp_path / "turntable.json")]
    assert main(["pose", str(photos), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
