"""What may be replaced: what mvseg wrote for the same purpose, and nothing that a command reads."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from mvseg.cli import main
from mvseg.errors import InputError
from mvseg.results.earlier import KINDS, Output, check_out, replace_result

Said, Patch = pytest.CaptureFixture[str], pytest.MonkeyPatch


def write_output(out: Path, output: Output, file: str = "table.csv") -> Path:
    with replace_result(out, {}, output) as folder:
        (folder / file).write_text("numbers")
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    (tmp_path / "plant").mkdir()
    return tmp_path / "plant"


@pytest.mark.parametrize("wrote", ["result", "tracks", "tables", "scene"])
@pytest.mark.parametrize("writes", list(KINDS))
def test_a_command_replaces_its_own_kind_only(wrote: str, writes: str, tmp_path: Path) -> None:
    out = write_output(tmp_path / "out", Output(wrote))
    before = contents(out)
    if wrote == writes:
        check_out(out, Output(writes))
        return
    with pytest.raises(InputError, match=r"out: holds .* expected (another folder|a new or empty folder)$"):
        write_output(out, Output(writes))
    assert contents(out) == before


def test_overwrite_replaces_other_kinds_but_keeps_what_it_does_not_know(plant: Path, tmp_path: Path) -> None:
    out = write_output(tmp_path / "out", Output("tracks"))
    message = "out: holds tracks of mvseg track, not a result of .*; expected another folder, or --overwrite true$"
    with pytest.raises(InputError, match=message):
        check_out(out, Output("result", of=(plant,), overwrite=False))
    (out / "notes.txt").write_text("mine")
    write_output(out, Output("result", of=(plant,), overwrite=True), "instances.json")
    assert contents(out).keys() == {"instances.json", "notes.txt", "run.json"}


def test_what_is_made_of_something_else_is_another_ones(plant: Path, tmp_path: Path) -> None:
    other = shutil.copytree(plant, tmp_path / "other")
    first, second = (write_output(tmp_path / name, Output("result", of=(plant,))) for name in ("r0", "r1"))
    tracks = write_output(tmp_path / "tracks", Output("tracks", of=(first,)))
    check_out(tracks, Output("tracks", of=(first, second)))  # a date more
    with pytest.raises(InputError, match=f"holds tracks of mvseg track, made of {first}, not of {second}"):
        check_out(tracks, Output("tracks", of=(second,)))
    with pytest.raises(InputError, match=f"holds a result of .*, made of {plant}, not of {other}; expected"):
        check_out(first, Output("result", of=(other,)))


def test_what_moved_together_is_still_the_same(plant: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    shutil.move(plant, home / "plant")
    write_output(home / "out", Output("result", of=(home / "plant",)))
    home.rename(tmp_path / "moved")
    check_out(tmp_path / "moved" / "out", Output("result", of=(tmp_path / "moved" / "plant",)))
    (tmp_path / "moved" / "plant").rename(tmp_path / "moved" / "other")
    with pytest.raises(InputError, match="holds a result of mvseg infer"):
        check_out(tmp_path / "moved" / "out", Output("result", of=(tmp_path / "moved" / "other",)))


def test_nothing_that_is_read_is_replaced(plant: Path, tmp_path: Path) -> None:
    """Under any name, and with --overwrite; what the user put into the folder stays there, and may be read."""
    out = write_output(tmp_path / "out", Output("result", of=(plant,)), "instances.json")
    (out / "corrections.json").write_text("mine")
    (tmp_path / "link").symlink_to(out)
    for read in (out, tmp_path / "link" / "instances.json", tmp_path / "plant" / ".." / "out"):
        for place in (out, tmp_path / "link", tmp_path / "absent" / ".." / "out"):
            with pytest.raises(InputError, match="is read by this run, which would replace it"):
                check_out(place, Output("result", reads=(read,), overwrite=True))
    check_out(out, Output("result", of=(plant,), reads=(out / "corrections.json",)))


def test_a_place_behind_a_folder_that_is_not_there_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("ten years of work")
    for kind in KINDS:
        with pytest.raises(InputError, match="holds files that are not"):
            check_out(tmp_path / "absent" / ".." / "mine", Output(kind))


@pytest.mark.parametrize("arguments", ["target page.pdf", "check plant --out .", "check plant --target --out ."])
def test_single_files_of_the_user_stay(
    arguments: str, plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("page.pdf", "walk.svg", "target.json"):
        Path(name).write_text("mine")
    assert main(arguments.split()) == 2
    assert "was not written by mvseg, expected another name, or to move it away" in capsys.readouterr().err
    assert {Path(name).read_text() for name in ("page.pdf", "walk.svg", "target.json")} == {"mine"}


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="a folder that looks writable and is not, of Linux")
@pytest.mark.parametrize("arguments", ["target /proc/page.pdf", "check . --out /proc/out", "track a b --out /proc/out"])
def test_a_place_is_tried_before_the_work(arguments: str, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    """Nobody waits for a lock there; and a read-only folder is not noticed after the minutes of a run."""
    monkeypatch.chdir(tmp_path)
    words = arguments.split() + (["--times", "1", "2"] if arguments.startswith("track") else [])
    assert main(words) == 2
    assert "the output folder is not writable (" in capsys.readouterr().err


def test_a_page_is_written_again(tmp_path: Path) -> None:
    for _ in range(2):
        assert main(["target", str(tmp_path / "page.pdf")]) == 0


def test_names_of_files_are_no_proof_of_a_training_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = {"config.yaml": "colour: red\n", "metrics.json": "{}", "broken_samples.txt": "photos\n"}
    for name, text in mine.items():
        (tmp_path / name).write_text(text)
    for output in (tmp_path, tmp_path / "absent" / ".." / ".." / tmp_path.name):
        words = [f"--photos={tmp_path}", f"--labels={tmp_path}", f"--output={output}"]
        assert main(["train", *words]) == 2
        assert "holds files that are not a run of mvseg train, expected a new or empty" in capsys.readouterr().err
    assert {name: (tmp_path / name).read_text() for name in os.listdir(tmp_path)} == mine
