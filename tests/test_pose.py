"""`mvseg pose`, from the command line: from photos to a scene that the other verbs read."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.cli import main
from mvseg.errors import InputError
from mvseg.formats.image_file import write_png
from mvseg.formats.photos import check_photos
from mvseg.formats.scene_folder import load_scene
from mvseg.poses.mapping import Structure
from mvseg.runs import pose_photos
from room_scene import room_cameras, write_room

BOARD = ["--board.columns", "5", "--board.rows", "4", "--board.square", "40", "--board.marker", "30"]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("room") / "photos", room_cameras(5))


def write_positions(path: Path) -> Path:
    centers = room_cameras(5).centers.numpy()
    rows = [f"{view}.png,{x},{y},{z}" for view, (x, y, z) in enumerate(centers)]
    path.write_text("\n".join(["photo,x_mm,y_mm,z_mm", *rows]))
    return path


def test_a_folder_of_photos_becomes_a_scene(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, positions = tmp_path / "scene", write_positions(tmp_path / "log.csv")
    command = ["pose", str(photos), "--out", str(out), "--positions", str(positions), "--up", "0 0 1"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert f"{out}: 5 of 5 photos registered, 0." in said.out
    assert "scale from 5 positions of log.csv, residual 0." in said.out
    assert "of 360 degrees round the plant; none from the" in said.out.split("mvseg: look at: ")[0]
    assert all(step in said.err for step in ("photos:", "features:", "matching:", "mapping:"))  # no silent minute
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.csv", "scene"]
    assert sorted(path.name for path in out.iterdir()) == ["cameras.json", "images", "pose.json", "sparse", "walk.svg"]

    scene, truth = load_scene(out), room_cameras(5)
    check_photos(scene)
    assert (scene.unit, scene.up) == ("mm", (0.0, 0.0, 1.0))
    assert [view.name for view in scene.views] == [str(view) for view in range(5)]
    np.testing.assert_allclose(scene.cameras.centers, truth.centers, atol=2)  # mm
    report = json.loads((out / "pose.json").read_text())
    assert report["registered"] == [f"{view}.png" for view in range(5)]
    assert report["residual_px"] < 0.5

    # A second run replaces what mvseg wrote, keeps what the user put there, and says the same, bit by bit.
    (out / "masks").mkdir()
    (out / "masks" / "0.png").write_bytes(b"mine")
    first = {name: (out / name).read_bytes() for name in ("cameras.json", "sparse/0/images.bin")}
    assert main([*command, "--quiet"]) == 0
    assert {name: (out / name).read_bytes() for name in first} == first
    assert (out / "masks" / "0.png").read_bytes() == b"mine"
    assert capsys.readouterr().err == ""

    # What the user changed is not replaced.
    (out / "cameras.json").write_text("{}")
    assert main(["pose", str(photos), "--out", str(out), "--quiet"]) == 2
    assert "cameras.json: was changed after mvseg wrote it" in capsys.readouterr().err
    assert (out / "cameras.json").read_text() == "{}"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Structure from motion is not reached, or would take its time."""
    calls: list[object] = []

    def refuse(*args: object, **options: object) -> Structure:
        calls.append(options)
        raise InputError("structure from motion was reached")

    monkeypatch.setattr(pose_photos, "find_structure", refuse)
    return calls


def test_options_become_config(photos: Path, tmp_path: Path, quick: list, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = tmp_path / "camera.yaml"
    calibration.write_text("camera_matrix: [500, 0, 240, 0, 500, 180, 0, 0, 1]\n")
    options = ["--pairs", "sequential", "--image_size", "800", "--camera_model", "OPENCV", "--shared_camera", "true",
               "--min_registered", "5", "--calibration", str(calibration)]  # fmt: skip
    assert main(["pose", str(photos), "--out", str(tmp_path / "out"), *options, *BOARD]) == 2
    assert "structure from motion was reached" in capsys.readouterr().err
    config = quick[0]["config"]
    assert (config.pairs, config.image_size, config.camera_model) == ("sequential", 800, "OPENCV")
    assert (config.shared_camera, config.min_registered) == (True, 5)
    assert quick[0]["calibration"].K[0].tolist() == [500, 0, 240.5]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["camera.yaml"]  # nothing is left behind


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--distance", "a", "b", "c"], "distance: 'c' is not a length"),
        (["--distance", "a", "b", "0"], "distance is 0 long"),
        (["--marker", "3", "--distance", "a", "b", "1"], "marker and distance both give a scale"),
        ([*BOARD, "--marker", "30"], "board and marker both give a scale"),
        (["--positions", "nowhere.csv"], "No such file or directory), expected a table of positions"),
        (["--calibration", "nowhere.yaml"], "No such file or directory), expected camera_matrix"),
        (["--up", "0 0"], "up is '0 0'"),
        (["--unit", "mm"], "unit is mm, and no length is known: expected --marker, --distance, ... with it"),
        (["--image_size", "null"], "image_size"),
    ],
)
def test_wrong_options_cost_no_time(
    photos: Path, tmp_path: Path, quick: list, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["pose", str(photos), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert quick == []
    assert list(tmp_path.iterdir()) == []


def test_places_that_are_not_ours(
    photos: Path, tmp_path: Path, quick: list, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = tmp_path / "plant"
    shutil.copytree(photos, plant / "images")
    assert main(["pose", str(plant / "images"), "--out", str(plant)]) == 2
    assert "the photos lie in it, expected a folder of its own" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["pose", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert "found 0 photos" in capsys.readouterr().err
    assert quick == []
    write_png(plant / "images" / "8.png", np.zeros((20, 30, 3), np.uint8))
    (plant / "images" / "8.png").write_bytes((plant / "images" / "8.png").read_bytes()[:-9])
    assert main(["pose", str(plant / "images"), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "8.png: the photo cannot be read" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "plant"]


def test_a_video_gives_photos(tmp_path: Path, quick: list, capsys: pytest.CaptureFixture[str]) -> None:
    """Or one sentence, and nothing is left behind."""
    picture = np.random.default_rng(0).integers(0, 255, (50, 80, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    for name, step in (("walk.mp4", 8), ("still.mp4", 0)):
        video = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"mp4v"), 15, (320, 240))
        for frame in range(24):
            video.write(np.ascontiguousarray(picture[:240, step * frame : step * frame + 320]))
        video.release()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    for name, message in (
        ("walk.mp4", "structure from motion was reached"),
        ("still.mp4", "still.mp4: the picture moves by 0% of its longer side in 24 frames, expected 8% or more"),
        ("broken.mp4", "broken.mp4: the video cannot be opened"),
        ("nowhere.mp4", "nowhere.mp4: no such folder, expected a folder of photos or a video"),
    ):
        assert main(["pose", str(tmp_path / name), "--out", str(tmp_path / "out"), "--quiet"]) == 2
        assert message in capsys.readouterr().err
    assert len(quick) > 1  # frames between those that do not register are tried, too
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.mp4", "still.mp4", "walk.mp4"]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals of POSIX systems")
@pytest.mark.parametrize(
    ("number", "step", "code", "said"),
    [
        (signal.SIGTERM, "mapping", 143, "mvseg: stopped by SIGTERM"),
        (signal.SIGINT, "features", 130, "mvseg: interrupted"),
    ],
)
def test_a_signal_ends_it_with_one_sentence(
    photos: Path, tmp_path: Path, number: int, step: str, code: int, said: str
) -> None:
    """The signal comes when the bar of a step shows up on a terminal, while COLMAP works."""
    import termios

    command = [sys.executable, "-m", "mvseg.cli", "pose", str(photos), "--out", str(tmp_path / "out")]
    root = Path(__file__).parent.parent
    terminal, stderr = os.openpty()
    termios.tcsetwinsize(stderr, (24, 80))
    run = subprocess.Popen(
        command,
        stderr=stderr,
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs of a shell ignore it
    )
    os.close(stderr)
    heard = b""
    while f"{step}:".encode() not in heard:
        heard += os.read(terminal, 1024)
    time.sleep(0.1)
    run.send_signal(number)
    rest = ""
    with suppress(OSError):  # the terminal has nobody left who writes
        while data := os.read(terminal, 1024):
            rest += data.decode()
    os.close(terminal)
    assert run.wait() == code, rest
    assert rest.splitlines()[-1].endswith(said)
    assert "Traceback" not in rest
    assert "***" not in rest  # pycolmap's trace
    assert list(tmp_path.iterdir()) == []
