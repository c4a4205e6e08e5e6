"""Camera positions, as carriages and robots log them, or turntable angles, one per photo: CSV.

    photo,x,y,z          photo,angle
    000.jpg,75,375,80    000.jpg,7.5

The first column may be called photo, image, file, filename or name; x, y and z may have a unit, as in x_mm. Columns may
be separated by commas, semicolons or tabs; other columns are ignored. Positions may also be JSON with a list of views:
{"views": [{"file": "images/000.jpg", "x_mm": 75, "y_mm": 375, "z_mm": 80}, ...]}.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.text_file import read_table

NAMES = ("photo", "image", "file", "filename", "file_name", "name")
AXIS = re.compile(r"([xyz])(?:[_ ]?[\[(]?(mm|cm|dm|m|um|in|ft)[\])]?)?")
Rows = Sequence[Mapping[Any, Any]]


class _Positions(BaseModel):
    views: Items[dict[str, Any]]


def read_positions(path: Path) -> tuple[list[str], np.ndarray, str]:
    """Read the camera positions of photos: names of the photos, (P, 3) float64, and the unit that the file states, or
    "". Raises InputError if the file cannot be read, has no columns for photo, x, y and z, holds other things than
    numbers there, names a photo twice or has columns in different units."""
    rows = read_json(path, _Positions).views if path.suffix.lower() == ".json" else _read_table(path, "positions")
    if not rows:
        raise InputError(f"{path}: holds no positions, expected a line for each photo")
    keys = _columns(rows)
    axes = {match[1]: (key, match[2] or "") for name, key in keys.items() if (match := AXIS.fullmatch(name))}
    if "photo" not in keys or set(axes) != set("xyz"):
        raise InputError(f"{path}: found the columns {', '.join(map(str, rows[0]))}; expected photo, x, y, z")
    if len({unit for _, unit in axes.values()}) > 1:
        raise InputError(f"{path}: x, y and z are in different units, expected one")
    found = _by_photo(path, rows, [keys["photo"], *(axes[axis][0] for axis in "xyz")], what="position")
    return list(found), np.array(list(found.values())), axes["x"][1]


def read_photo_angles(path: Path) -> dict[str, float]:
    """{name of the photo, as in the file: degrees}. Raises InputError if the file cannot be read, has no columns for
    photo and angle, holds other things than numbers there, or names a photo twice."""
    rows = _read_table(path, "angles")
    keys = _columns(rows)
    if not {"photo", "angle"} <= keys.keys():
        found = ", ".join(map(str, rows[0])) if rows else "nothing"
        raise InputError(f"{path}: found the columns {found}; expected photo, angle and a line for each photo")
    by_photo = _by_photo(path, rows, [keys["photo"], keys["angle"]], what="angle")
    return {name: angle for name, (angle,) in by_photo.items()}


def _read_table(path: Path, what: str) -> Rows:
    (_, columns), *rows = read_table(path, f"a table of {what}") or [(0, [])]
    return [dict(zip_longest(columns, cells[: len(columns)])) for _, cells in rows]


def _columns(rows: Rows) -> dict[str, Any]:
    keys = {str(key).strip().lower(): key for key in (rows[0] if rows else ())}
    photo = next((keys[name] for name in NAMES if name in keys), None)
    return keys if photo is None else keys | {"photo": photo}


def _by_photo(path: Path, rows: Rows, columns: Sequence[Any], *, what: str) -> dict[str, list[float]]:
    positions: dict[str, list[float]] = {}
    for index, row in enumerate(rows):
        name = row.get(columns[0])
        if not isinstance(name, str) or not name:
            raise InputError(f"{path}: {what} {index} has no photo in '{columns[0]}'")
        if name in positions:
            raise InputError(f"{path}: photo {name} has two {what}s, expected one")
        positions[name] = [_read_number(row.get(column), f"{path}: {column} of {name}") for column in columns[1:]]
    return positions


def _read_number(value: Any, where: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or abs(number) > 1e12:
        raise InputError(f"{where} is {value!r}, expected a number")
    return number
