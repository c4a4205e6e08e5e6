"""By how much a turntable had turned at each photo, as its controller logs it: CSV.

    photo,angle
    000.jpg,0
    001.jpg,7.5

The first column may be called photo, image, file, filename or name. Columns may be separated by commas, semicolons or
tabs; other columns are left alone.
"""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError
from mvseg.formats.positions import NAMES, read_number, read_table


def read_photo_angles(path: Path) -> dict[str, float]:
    """{name of the photo, as in the file: degrees}.

    Raises:
        InputError: the file cannot be read, has no columns for photo and angle, holds something else than numbers
            there, or names a photo twice.
    """
    rows = read_table(path, "angles")
    keys = {} if not rows else {str(key).strip().lower(): key for key in rows[0] if key is not None}
    photo = next((keys[name] for name in NAMES if name in keys), None)
    if photo is None or "angle" not in keys:
        found = ", ".join(keys) or "nothing"
        raise InputError(f"{path}: found the columns {found}; expected photo, angle and a line for each photo")
    angles: dict[str, float] = {}
    for index, row in enumerate(rows):
        name = row.get(photo)
        if not name:
            raise InputError(f"{path}: angle {index} has no photo in '{photo}'")
        if name in angles:
            raise InputError(f"{path}: photo {name} has two angles, expected one")
        angles[name] = read_number(row.get(keys["angle"]), f"{path}: the angle of {name}")
    return angles
