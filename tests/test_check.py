"""`mvseg check`: what a user sees, and the exit code."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvseg.checks.check_scene import check_scene
from mvseg.cli import main
from mvseg.config import RunConfig
from mvseg.demo import demo_scene as demo_folder
from mvseg.errors import InputError, InputWarning
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.pipeline.run_scene import run_scene
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.regions import Regions
from mvseg.scene import Scene
from scene_folders import write_image, write_scene


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    """A copy of the shipped scene, for tests that break it."""
    return Path(shutil.copytree(demo_folder(), tmp_path / "plant"))


def test_a_good_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(demo_folder()), "--masks", "masks", "--quiet", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "9 cameras, unit mm, up 0.00 0.00 1.00" in said
    assert "9 of 9 look at one point; 9 photos; 108 masks" in said
    assert said.endswith("\nno problems found\n")
    content = json.loads((tmp_path / "out" / "check.json").read_text())
    assert content["findings"] == []
    assert [view["masks"] for view in content["views"]] == [12] * 9
    assert [view["miss_px"] for view in content["views"]] == [0] * 9
    assert "photos from 199 of 360 degrees" in (tmp_path / "out" / "walk.svg").read_text()


def test_a_fault_is_an_exit_code_of_1(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = json.loads((plant / "cameras.json").read_text())
    first, second = rig["views"][2], rig["views"][5]
    for key in ("R", "t"):
        first[key], second[key] = second[key], first[key]
    (plant / "cameras.json").write_text(json.dumps(rig))
    assert main(["check", str(plant), "--masks", "masks", "--quiet", "--out", str(tmp_path / "out")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line[:35] for line in lines[-2:]] == [f"error    poses    view {view} (00{view}) agre" for view in (2, 5)]
    content = json.loads((tmp_path / "out" / "check.json").read_text())
    assert [finding["views"] for finding in content["findings"]] == [[2], [5]]
    assert (tmp_path / "out" / "walk.svg").read_text().count('<g fill="#d73027">') == 2


def edit_cameras(plant: Path, edit: Callable[[int, dict[str, Any]], object]) -> None:
    """Change each entry of the rig file, by its index."""
    rig = json.loads((plant / "cameras.json").read_text())
    for index, entry in enumerate(rig["views"]):
        edit(index, entry)
    (plant / "cameras.json").write_text(json.dumps(rig))


def move_every_second(index: int, entry: dict[str, Any]) -> None:
    entry["t"] = (np.array(entry["t"]) * (1.2 if index % 2 == 0 else 1)).tolist()


def test_a_run_warns_of_it(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edit_cameras(plant, move_every_second)
    monkeypatch.setattr("mvseg.pipeline.run_scene.measure", lambda result, *_: result)  # no shape is looked at
    config = RunConfig(reconstruct=ReconstructConfig(shape="voxels"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        result = run_scene(plant, plant / "masks", config)
    warned = [each.message.finding for each in caught if isinstance(each.message, InputWarning)]
    assert [each.code for each in warned].count("separate_worlds") == 1
    assert [each for each in result.findings if each.level != "note"] == warned


def test_a_warning_is_none(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_image(plant / "masks" / "004.png", np.zeros((480, 640), np.uint16))
    assert main(["check", str(plant), "--masks", "masks", "--quiet"]) == 0
    assert "warning  masks    there are no masks in view 4 (004)" in capsys.readouterr().out


def test_what_readers_warn_of_is_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_scene(tmp_path / "plant")
    for path in (folder / "masks").iterdir():
        write_image(path, np.where(cv2.imread(str(path), -1) > 0, 255, 0).astype(np.uint8))
    assert main(["check", str(folder), "--masks", "masks", "--quiet"]) == 0
    captured = capsys.readouterr()
    assert "holds 0 and 255 only" in captured.out
    assert captured.err == ""


def test_masks_that_cannot_be_read_come_after_what_can(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_image(plant / "masks" / "004.png", np.zeros((48, 64), np.uint16))
    shutil.rmtree(plant / "images")
    assert main(["check", str(plant), "--masks", "masks", "--quiet"]) == 2
    captured = capsys.readouterr()
    assert "9 of 9 look at one point; 0 photos" in captured.out
    assert "neither photos nor masks" not in captured.out
    assert "no problems found" not in captured.out
    assert captured.err.startswith("mvseg: error: ")
    assert "64 x 48" in captured.err


def test_from_python(demo_scene: Scene, demo_regions: Regions) -> None:
    few = replace(demo_scene, views=demo_scene.views[:5], cameras=demo_scene.cameras[:5])
    check = check_scene(few)
    assert (check.findings, check.agreement) == ((), None)
    with pytest.raises(InputError, match="regions of 9 views with 5 cameras"):
        check_scene(few, demo_regions)


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("plant", "masks"), [("basil-0729", "masks"), ("maize-plant1", "silhouettes"), ("fern-llff", None)]
)
def test_real_plants_have_no_error(plant: str, masks: str | None, shared_data: Path) -> None:
    scene = load_scene(shared_data / plant)
    if masks is None:  # half of the photos show what all do
        scene = replace(scene, views=scene.views[::2], cameras=scene.cameras[::2])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        regions = None if masks is None else load_masks(scene, shared_data / plant / masks)
    check = check_scene(scene, regions)
    warned = [finding.code for finding in check.findings if finding.level != "note"]
    assert warned == {"maize-plant1": ["stray_pixels"], "fern-llff": ["one_sided"]}.get(plant, [])


def test_a_result_says_what_the_check_finds(tmp_path: Path) -> None:
    plant = write_scene(tmp_path / "plant", 4)
    shutil.copyfile(plant / "images" / "001.png", plant / "images" / "002.png")
    write_image(plant / "images" / "003.png", np.full((96, 128, 3), 255, np.uint8))
    for report in (True, False):
        out = tmp_path / f"out-{report}"
        assert main(["match", str(plant), "--out", str(out), "--report", str(report).lower(), "--quiet"]) == 0
        run = json.loads((out / "plant" / "run.json").read_text())
        scene = load_scene(plant)
        findings = check_scene(scene, load_masks(scene, plant / "masks")).findings
        assert [finding.code for finding in findings if finding.level == "error"] == ["blank_photo", "same_photo"]
        assert {finding.code for finding in findings} <= {each["code"] for each in run["findings"]}


def test_a_result_is_checked_with_its_own_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["match", str(write_scene(tmp_path / "plant", 4)), "--out", str(out), "--quiet"]) == 0
    run = json.loads((out / "plant" / "run.json").read_text())
    assert main(["check", str(out / "plant"), "--quiet", "--out", str(tmp_path / "checked")]) == 0
    assert "4 of 4 look at one point; 4 photos; 12 masks" in capsys.readouterr().out
    checked = json.loads((tmp_path / "checked" / "check.json").read_text())
    assert checked["findings"] == run["findings"]
    assert main(["check", str(out / "plant"), "--masks", "masks", "--quiet"]) == 2


def test_masks_of_turned_photos_are_an_error(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And in a run a warning; the photos are not told to be anything else than they are."""
    for path in (plant / "masks").iterdir():
        write_image(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::-1, ::-1])
    scene = load_scene(plant)
    regions = load_masks(scene, plant / "masks")
    (found,) = check_scene(scene, regions).findings
    assert (found.code, found.topic, found.level) == ("turned_masks", "masks", "error")
