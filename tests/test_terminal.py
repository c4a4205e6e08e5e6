"""What the command does with a terminal: characters that it does not have, and the completion of words."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from mvseg.cli import main
from scene_folders import write_scene

COMPLETE = """
source "$1"; shift
COMP_WORDS=(mvseg "$@"); COMP_CWORD=$#; COMPREPLY=()
_shtab_mvseg mvseg "${COMP_WORDS[-1]}" "${COMP_WORDS[-2]}"
echo "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize("encoding", ["ascii", "cp1251", "utf-8"])
def test_a_terminal_without_some_of_our_characters(
    encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a console of Windows has it, or a pipe there."""
    scene = write_scene(tmp_path / "größe", 2)
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding=encoding, newline="\n"))
    assert main(["match", str(scene), "--out", str(tmp_path / "out"), "--quiet", "--report", "false"]) == 0
    sys.stdout.flush()
    shown = {"utf-8": "größe"}.get(encoding, "gr??e")
    assert f"{shown}: 3 instances from 6 masks" in written.getvalue().decode(encoding)


def test_completion_in_bash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also of the options that the short help leaves out."""
    pytest.importorskip("shtab")
    if subprocess.run(["bash", "-c", "type complete"], capture_output=True, check=False).returncode:
        pytest.skip("no bash that completes")
    with pytest.raises(SystemExit) as stop:
        main(["--print_completion", "shtab-bash"])
    assert stop.value.code == 0
    (tmp_path / "mvseg.bash").write_text(capsys.readouterr().out)

    def complete(*words: str) -> list[str]:
        command = ["bash", "-c", COMPLETE, "bash", str(tmp_path / "mvseg.bash"), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    assert complete("inf") == ["infer"]
    assert complete("infer", "--mas") == ["--masks"]
    assert complete("infer", "--match.num_r") == ["--match.num_restarts"]
    assert complete("infer", "--coco_crowd", "") == ["mask", "ignore"]
    assert complete("batch", "--res") == ["--resume"]


def test_what_completion_needs_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("mvseg.cli.command.find_spec", lambda name: None)
    assert main(["--print_completion", "shtab-bash"]) == 2
    assert capsys.readouterr().err == "mvseg: error: --print_completion needs shtab: pip install shtab\n"
