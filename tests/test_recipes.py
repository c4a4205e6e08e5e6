"""The recipes for other programs: the example files are what the script makes, and the page's commands take them."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

import recipe_files
from mvseg.cli import main
from mvseg.demo import demo_scene
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_masks, load_scene

ROOT = Path(__file__).parent.parent
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
PAGE = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^(mvseg check .*docs/recipes/.*)$", PAGE, re.MULTILINE)


def test_example_files_are_what_the_script_makes(tmp_path: Path) -> None:
    recipe_files.write_all(tmp_path)
    made, shipped = (
        {path.relative_to(folder).as_posix(): path.read_text() for path in folder.glob("*/**/*.*")}
        for folder in (tmp_path, recipe_files.FOLDER)
    )
    assert made.keys() == shipped.keys()
    for name, text in made.items():
        if name.endswith(".json"):
            assert text == shipped[name]
        else:  # cameras, whose last digits are those of the processor
            numbers, expected = ([float(word) for word in NUMBER.findall(each)] for each in (text, shipped[name]))
            assert numbers == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_recipes_run(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    words = shlex.split(command.replace("$plant", str(demo_scene())))
    assert main([*words[1:], "--quiet"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"; (36|108) masks\n", said)  # 12 in each of three or nine photos
    assert len(COMMANDS) == 5


def test_of_all_that_sam_finds_the_leaves_are_kept(tmp_path: Path) -> None:
    """By the function on the page: without it, background, plant and halves are masks, too."""
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "def keep_leaves" in block)
    scope: dict[str, Any] = {}
    exec(code, scope)
    scene = load_scene(demo_scene())
    for view, (width, height) in zip(scene.views, scene.cameras.sizes.tolist(), strict=True):
        found = recipe_files.sam_entries(read_label_png(demo_scene() / "masks" / f"{view.name}.png", width, height))
        kept = scope["keep_leaves"](found, width * height)
        (tmp_path / f"{view.name}.json").write_text(json.dumps(kept))
    given, kept = (load_masks(scene, folder) for folder in (demo_scene() / "masks", tmp_path))
    assert kept.num_per_view.tolist() == given.num_per_view.tolist()
    assert sorted(kept.areas.tolist()) == sorted(given.areas.tolist())


def test_what_cellpose_leaves_beside_the_photos_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its label images; no word of its pickles, which hold the same masks."""
    plant = shutil.copytree(demo_scene(), tmp_path / "plant")
    recipe_files.write_cellpose(plant / "images")
    assert main(["match", str(plant), "--masks", "images", "--out", str(tmp_path / "ids"), "--quiet"]) == 0
    said = capsys.readouterr()
    assert "12 instances from 108 masks (label images) in 9 views" in said.out
    assert said.err == ""
    for path in (plant / "images").glob("*_cp_masks.png"):
        path.unlink()
    assert main(["match", str(plant), "--masks", "images", "--out", str(tmp_path / "ids"), "--quiet"]) == 2
    assert "is a pickle, which may run anything when it is read; in cellpose, save" in capsys.readouterr().err
