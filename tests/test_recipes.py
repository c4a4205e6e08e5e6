"""The recipes for other programs: the example files are what the script makes, and the page's commands take them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import recipe_files
from mvseg.cli import main
from mvseg.demo import demo_scene

ROOT = Path(__file__).parent.parent
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
PAGE = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^(mvseg check .*docs/recipes/.*)$", PAGE, re.MULTILINE)


def test_example_files_are_what_the_script_makes(tmp_path: Path) -> None:
    recipe_files.write_all(tmp_path)
    made, shipped = (
        {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}
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
