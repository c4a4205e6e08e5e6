"""YAML files: what a parser must not be given is one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvseg.errors import InputError
from mvseg.formats.text_file import read_table, read_yaml

BOMB = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"masks: m # \xff\xfe", "byte 11 is not UTF-8"),
        (b"match: {seed: " + b"1" * 5000 + b"}", "is not a YAML file .*5000 digits"),
        (b"\nmatch: " + b"[" * 20_000, "is not a YAML file"),
        (b"match: " + b"{a: " * 2000 + b"1" + b"}" * 2000, r"is not a YAML file \(line 1 is nested more than 100"),
        (BOMB.encode(), r"is not a YAML file \(line 2 has the alias \*a"),
        (b"\0", "is not a YAML file"),
        (b"match: {a: [3", "is not a YAML file"),
        (b"#" * (1 << 21), "is larger than 1048576 bytes"),
    ],
)
def test_files_that_are_not_parsed(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"run\.yaml: {message}"):
        read_yaml(path, "options")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_yaml(tmp_path, "options")


@pytest.mark.parametrize("text", ["", "masks: masks\nmatch: {num_points: 3, search_range: [2, 5]}\n# Blätter\n"])
def test_options_are_fine(text: str, tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text(text, encoding="utf-8")
    read_yaml(tmp_path / "run.yaml", "options")


def test_a_table_is_read_as_spreadsheets_and_editors_write_it(tmp_path: Path) -> None:
    """Numbers of lines are those of an editor, also after a cell of two lines."""
    path = tmp_path / "table.csv"
    path.write_bytes('\ufeffa; b ;c\r\n\r\n1;"two\nlines, in one"\r\n;\r\n3; 4;5\r\n'.encode())
    assert read_table(path, "a table") == [(1, ["a", "b", "c"]), (4, ["1", "two\nlines, in one"]), (6, ["3", "4", "5"])]
    path.write_text("")
    assert read_table(path, "a table") == []
    for encoding in ("utf-16", "utf-8-sig"):  # Excel's "Unicode text", and its "CSV UTF-8"
        path.write_bytes("sep=;\r\nphoto;Höhe;;\r\na;1,5;;\r\nb;;;\r\n".encode(encoding))
        assert read_table(path, "a table") == [(2, ["photo", "Höhe"]), (3, ["a", "1,5"]), (4, ["b", ""])]
    path.write_bytes("photo\tx\n".encode("utf-16") + b"\x00")
    with pytest.raises(InputError, match=r"table\.csv: begins as UTF-16 and is not, expected a table"):
        read_table(path, "a table")
    path.write_bytes(b"a,b\n1,\xff\n")
    with pytest.raises(InputError, match=r"table\.csv: byte 6 is not UTF-8, expected a table"):
        read_table(path, "a table")
