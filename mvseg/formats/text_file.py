"""Text, CSV and YAML files that people write, read whole, each fault one sentence; and the tables that mvseg writes."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from mvseg.errors import InputError
from mvseg.system.atomic import write_text_whole

MAX_BYTES, MAX_TABLE = 1 << 20, 1 << 26  # limit: bytes of a file, and of a table
DEEPEST = 100  # limit: of lists and mappings in one another, in YAML
FORMULA_STARTS = ("=", "+", "-", "@")
NUMBER = re.compile(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", re.IGNORECASE)
Cell = str | float | None


def read_bytes(path: Path, expected: str, *, most: int = MAX_BYTES) -> bytes:
    """The bytes of a file. Raises InputError, which names the path and what was expected, if it cannot be read, or has
    more than `most` bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected {expected}") from None
    if len(data) > most:
        raise InputError(f"{path}: is larger than {most} bytes, expected {expected}")
    return data


def read_text(path: Path, expected: str, *, most: int = MAX_BYTES) -> str:
    """The text of a file, without the byte order mark that Windows editors write. Raises InputError as `read_bytes`, or
    if it is not UTF-8."""
    return _decode(read_bytes(path, expected, most=most), path, expected)


def _decode(data: bytes, path: Path, expected: str) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8, expected {expected}") from None


def read_table(path: Path, expected: str, *, most: int = MAX_TABLE) -> list[tuple[int, list[str]]]:
    """The rows of a CSV file that are not empty, the header first: number of the line, and cells without space around
    them. Cells are separated by commas, semicolons or tabs, whichever the header has most of. Excel's forms are read,
    too: UTF-16, a first line "sep=;", and cells without content at the ends of all lines. Raises InputError as
    `read_text`, or if it is not CSV."""
    data = read_bytes(path, expected, most=most)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16") if is_wide else _decode(data, path, expected)
    except UnicodeDecodeError:
        raise InputError(f"{path}: begins as UTF-16 and is not, expected {expected}") from None
    stated = re.match(r'"?sep=([,;\t])"?\r?\n', text)
    text = "\n" * bool(stated) + text[stated.end() if stated else 0 :]  # the numbers of its lines stay
    delimiter = stated[1] if stated else max(",;\t", key=text.partition("\n")[0].count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num} is not CSV ({error})") from None
    rows = [(line, cells) for line, cells in rows if any(cells)]
    width = max((number for _, cells in rows for number, cell in enumerate(cells, start=1) if cell), default=0)
    named = len(rows[0][1]) if rows else 0
    return [(line, cells[: max(width, 1)] if len(cells) == named else cells) for line, cells in rows]


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> None:
    """Write a CSV file in UTF-8 with a header, whole or not at all, that pandas and spreadsheets open: whole numbers as
    they are, other numbers by `format_number`, text by `escape_text`, None as ""."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *([_as_cell(value) for value in row] for row in rows)])
    write_text_whole(path, text.getvalue())


def _as_cell(value: Cell) -> str | int:
    if isinstance(value, str):
        return escape_text(value)
    return value if isinstance(value, int) else "" if value is None else format_number(value)


def format_number(value: float) -> str:
    """Six significant digits; "" for what is not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""


def short_number(value: float) -> float | None:
    """The number that `format_number` writes, for JSON; None for what is not finite."""
    return float(format_number(value)) if np.isfinite(value) else None


def escape_text(text: str) -> str:
    """Text in one line that no spreadsheet takes for a formula; numbers stay numbers, also negative ones."""
    text = " ".join(text.split())
    return f"'{text}" if text.startswith(FORMULA_STARTS) and not NUMBER.fullmatch(text) else text


def read_yaml(path: Path, expected: str, *, loader: Any = yaml.SafeLoader) -> Any:
    """Content of a YAML file; a line of OpenCV, "%YAML:1.0", is left out. Raises InputError as `read_text`, or if it is
    not YAML that Python can hold, or uses aliases (nested ones expand 300 bytes into billions of values)."""
    text = "\n".join("" if line.startswith("%YAML:") else line for line in read_text(path, expected).split("\n"))
    try:
        depth = 0
        for each in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(each, yaml.CollectionStartEvent) - isinstance(each, yaml.CollectionEndEvent)
            if isinstance(each, yaml.AliasEvent):
                raise ValueError(f"line {each.start_mark.line + 1} has the alias *{each.anchor}, expected plain values")
            if depth > DEEPEST:  # yaml takes minutes to find that it cannot hold it
                raise ValueError(f"line {each.start_mark.line + 1} is nested more than {DEEPEST} times")
        return yaml.load(text, loader)
    except Exception as error:  # yaml raises its own kinds, and those of its builders
        raise InputError(f"{path}: is not a YAML file ({' '.join(str(error).split())}), expected {expected}") from None
