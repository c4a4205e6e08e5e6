"""Everything in a code block of README.md and docs/ runs: Python, commands, and the files that are shown.

What a block is stands behind its backticks: `python`; nothing for commands, one a line; `json` for camera files; `bash`
for scripts; `text`, `csv` and `r` are only looked at. An HTML comment on the line before a block says more of it:
`<!-- slow -->` runs it with the slow tests, as a script of its own, and `<!-- not run: WHY -->` leaves it alone.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import mvseg
from mvseg import demo_scene, load_scene
from mvseg.cli import command, main
from mvseg.cli.options import join_up
from mvseg.corrections.file import FORMAT, parse_corrections
from mvseg.formats.label_png import read_labels, write_label_png

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(?:^<!-- ([^\n]*) -->\n)?^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
KINDS = {"python", "", "json", "bash", "text", "csv", "r"}
LONG = {"pose", "train", "track"}  # verbs that need photos, tables or minutes; their own tests run them
SCENES = ("SCENE", "basil", "tomato", "maize", "PLANTS/one", "PLANTS/two")
WEIGHTS = ("runs/mine/model.safetensors", "runs/adapted/weights.safetensors")
NUM_VIEWS, NUM_LEAVES = 3, 4  # of the shipped plant's nine and twelve: quicker


@dataclass(frozen=True)
class Block:
    """A code block of a page: where it begins, its kind, and what the comment before it says."""

    page: Path
    line: int
    kind: str
    mark: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"

    @property
    def commands(self) -> list[list[str]]:
        """The words of each command; without their comments."""
        lines = [shlex.split(line, comments=True) for line in self.text.replace("\\\n", " ").splitlines()]
        return [words for words in lines if words]


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, text.count("\n", 0, found.start(2)) + 1, found[2], found[1] or "", found[3])
        for found in BLOCK.finditer(text)
    ]


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
RUN = [block for block in BLOCKS if not block.mark.startswith("not run: ")]


def of_kind(*kinds: str, mark: str | None = None) -> pytest.MarkDecorator:
    blocks = [block for block in RUN if block.kind in kinds and mark in (None, block.mark)]
    assert blocks
    return pytest.mark.parametrize("block", blocks, ids=str)


def few_views(folder: Path, step: int = 9 // NUM_VIEWS) -> Path:
    """Take all but every so many views out of a copy of the shipped plant."""
    rig = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps(rig | {"views": rig["views"][::step]}))
    return folder


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped plant with masks of some leaves in some views."""
    folder = few_views(shutil.copytree(demo_scene(), tmp_path_factory.mktemp("snippets") / "plant"))
    for path in (folder / "masks").iterdir():
        masks, truth = read_labels(path), read_labels(folder / "truth" / path.name)
        write_label_png(path, np.where(truth <= NUM_LEAVES, masks, 0))
    return folder


@pytest.fixture
def desk(tmp_path: Path, plant: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with all that the commands of the pages name."""
    for name in SCENES:
        shutil.copytree(plant, tmp_path / name)
        shutil.copytree(plant / "truth", tmp_path / name / "true_labels", ignore=shutil.ignore_patterns("leaves"))
    (tmp_path / "MASKS").symlink_to(tmp_path / "SCENE" / "masks")
    (tmp_path / "night.csv").write_text("scene\nbasil\ntomato\n")
    for name in WEIGHTS:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(ROOT / "models" / "leaf-lite" / "weights.safetensors")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_is_of_a_kind(page: Path) -> None:
    blocks = blocks_of(page)
    assert page.read_text(encoding="utf-8").count("```") == 2 * len(blocks)
    assert {block.kind for block in blocks} <= KINDS
    assert {block.mark for block in blocks if not re.fullmatch("(slow|not run: .+)?", block.mark)} == set()


@of_kind("python", mark="")
def test_python_runs(block: Block, plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mvseg, "demo_scene", lambda: plant)
    exec(compile(block.text, str(block), "exec"), {"__name__": "snippet"})


@pytest.mark.slow
@of_kind("python", mark="slow")
def test_long_python_runs(block: Block, desk: Path) -> None:
    if "results/basil" in block.text:
        assert main(["infer", "basil", "--masks", "masks", "--quiet", "--report", "false"]) == 0
    (desk / "snippet.py").write_text(block.text)
    where = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-W", "error", "snippet.py"], env=where, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@of_kind("")
def test_commands_are_understood(block: Block) -> None:
    targets = re.findall(r"^(\w+)[\w ]*:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for program, *words in block.commands:
        if program == "mvseg":
            command.build_parser().parse_args(join_up(words))
        else:
            assert program in ("make", "python"), block
            assert program == "python" or words[0] in targets, block


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({block.page for block in RUN if block.kind == ""}), ids=lambda page: page.name)
def test_commands_run(page: Path, desk: Path) -> None:
    commands = [words for block in RUN if (block.page, block.kind) == (page, "") for words in block.commands]
    for program, *words in commands:
        if program == "python" and words[0] == "-c":
            where = {**os.environ, "PYTHONPATH": str(ROOT)}
            subprocess.run([sys.executable, *words], check=True, env=where)
            few_views(desk / "plant", step=2)
        elif program == "mvseg" and words[0] not in LONG and "$" not in str(words):  # tests/test_recipes.py has those
            assert main(words) == 0, words
    if page.name == "guide.md":
        assert (desk / "results" / "plant" / "traits_wide.csv").is_file()
        assert json.loads((desk / "ids" / "plant" / "metrics.json").read_text())["ari"] == 1


@of_kind("json")
def test_files_that_are_shown_are_read(block: Block, tmp_path: Path) -> None:
    content = json.loads(block.text)
    if content["format"] == FORMAT:
        assert len(parse_corrections(content).edits) == len(content["edits"])
        return
    name = {"mvseg-rig/1": "cameras.json", "mvseg-turntable/1": "turntable.json"}[content["format"]]
    (tmp_path / name).write_text(block.text)
    (tmp_path / "side.yaml").write_text(
        "image_width: 640\nimage_height: 480\n"
        "camera_matrix: {rows: 3, cols: 3, data: [700, 0, 320, 0, 700, 240, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    assert len(load_scene(tmp_path).views) == len(content["views"])


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.kind == "bash"], ids=str)
def test_scripts_are_sound(block: Block) -> None:
    subprocess.run(["bash", "-n"], input=block.text, text=True, check=True)
