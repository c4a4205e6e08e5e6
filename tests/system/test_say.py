"""What a name or a file of a stranger holds reaches the terminal as text."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import mvseg
from mvseg.system.say import plain, say


def test_control_characters_are_shown_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    say("leaf\x1b]52;c;aGk=\x07 \x9b2J\u202egnp.exe", end="\t|\n")
    say("photo\x08s", to_stderr=True)
    captured = capsys.readouterr()
    assert captured.out == "leaf\\x1b]52;c;aGk=\\x07 \\x9b2J\\u202egnp.exe\t|\n"
    assert captured.err == "photo\\x08s\n"


@pytest.mark.parametrize("text", ["two\nlines\tand Kübel 15 ± 2 mm²", "葉", ""])
def test_other_text_stays(text: str) -> None:
    assert plain(text) == text
    assert plain(plain(text + "\x1b")) == plain(text + "\x1b")


def test_nothing_else_prints() -> None:
    package = Path(mvseg.__file__).parent
    for path in package.rglob("*.py"):
        if path.name != "say.py":
            source = path.read_text(encoding="utf-8")
            assert not re.search(r"(?<![\w.])print\(|std(out|err)\.write|tqdm\.write", source), path
