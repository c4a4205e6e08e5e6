"""Where the camera stood at each photo, as carriages and robots log it: CSV, or JSON with a list of views.

    photo,x,y,z                          {"views": [{"file": "images/000.jpg", "x_mm": 75, "y_mm": 375, "z_mm": 80},
    000.jpg,75,375,80                               ...]}

The first column may be called photo, image, file, filename or name; the others x, y, z, and perhaps their unit, as in
x_mm. Columns may be separated by commas, semicolons or tabs; other columns and keys are left alone.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.json_file import Items, read_json

NAMES = ("photo", "image", "file", "filename", "file_name", "name")
AXIS = re.compile(r"([xyz])(?:[_ ]?[\[(]?(mm|cm|dm|m|um|in|ft)[\])]?)?")
MAX_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class Positions:
    """Camera positions by photo.

    Attributes:
        names: of the photos, as in the file.
        xyz: (P, 3) float64.
        unit: that the file says; "" if none.
    """

    names: tuple[str, ...]
    xyz: np.ndarray
    unit: str = ""


class _Positions(BaseModel):
    views: Items[dict[str, Any]]


def read_positions(path: Path) -> Positions:
    """Read the camera positions of photos.

    Raises:
        InputError: the file cannot be read, has no columns for photo, x, y and z, holds something else than numbers
            there, names a photo twice or has columns in different units.
    """
    rows = read_json(path, _Positions).views if path.suffix.lower() == ".json" else read_table(path, "positions")
    if not rows:
        raise InputError(f"{path}: holds no positions, expected a line for each photo")
    columns, unit = _find_columns(path, rows[0])
    names, xyz = [], []
    for index, row in enumerate(rows):
        name, *numbers = (row.get(column) for column in columns)
        if not isinstance(name, str) or not name:
            raise InputError(f"{path}: position {index} has no photo in '{columns[0]}'")
        if name in names:
            raise InputError(f"{path}: photo {name} has two positions, expected one")
        names.append(name)
        found = zip(numbers, columns[1:], strict=True)
        xyz.append([read_number(value, f"{path}: {column} of {name}") for value, column in found])
    return Positions(names=tuple(names), xyz=np.array(xyz), unit=unit)


def read_table(path: Path, what: str) -> list[dict[str, Any]]:
    """The rows of a CSV file, as {column: entry}.

    Raises:
        InputError: it cannot be read as a table; `what` says of what it should be one.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: is too large for a table of {what}")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        head = lines[0] if lines else ""
        delimiter = max(",;\t", key=head.count)
        return list(csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True))
    except OSError as error:
        raise InputError(f"{path}: the {what} cannot be read ({error.strerror})") from None
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: is not a table of {what} ({error})") from None


def _find_columns(path: Path, row: Mapping[str, Any]) -> tuple[list[str], str]:
    """The columns of the photo, x, y, z; and the unit."""
    keys = {str(key).strip().lower(): key for key in row if key is not None}
    photo = next((keys[name] for name in NAMES if name in keys), None)
    axes, units = {}, set()
    for name, key in keys.items():
        match = AXIS.fullmatch(name)
        if match and match[1] not in axes:
            axes[match[1]] = key
            units.add(match[2] or "")
    if photo is None or set(axes) != set("xyz"):
        raise InputError(f"{path}: found the columns {', '.join(map(str, row))}; expected photo, x, y, z")
    if len(units) > 1:
        raise InputError(f"{path}: x, y and z are in different units, expected one")
    return [photo, *(axes[axis] for axis in "xyz")], units.pop()


def read_number(value: Any, where: str) -> float:
    """A number of moderate size; InputError, which begins with `where`, if it is none."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or abs(number) > 1e12:
        raise InputError(f"{where} is {value!r}, expected a number")
    return number
