from __future__ import annotations

from pathlib import Path

import pytest

from mvseg.errors import InputError
from mvseg.formats.positions import read_photo_angles


def write(folder: Path, text: str) -> Path:
    path = folder / "angles.csv"
    path.write_text(text)
    return path


def test_angles_by_photo(tmp_path: Path) -> None:
    assert read_photo_angles(write(tmp_path, "photo,angle\na.jpg,0\nb.jpg,-7.5\n")) == {"a.jpg": 0, "b.jpg": -7.5}
    assert read_photo_angles(write(tmp_path, "Time;File;Angle\n9;top/a.jpg;30\n")) == {"top/a.jpg": 30}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found the columns nothing; expected photo, angle"),
        ("photo,x\na.jpg,1\n", "found the columns photo, x; expected photo, angle"),
        ("photo,angle\na.jpg,north\n", "angle of a.jpg is 'north', expected a number"),
        ("photo,angle\na.jpg\n", "angle of a.jpg is None, expected a number"),
        ("photo,angle\na.jpg,1\na.jpg,2\n", "photo a.jpg has two angles, expected one"),
        ("photo,angle\n,1\n", "angle 0 has no photo in 'photo'"),
    ],
)
def test_broken_tables(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_photo_angles(write(tmp_path, text))


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be read .*, expected a table of angles"):
        read_photo_angles(tmp_path / "nowhere.csv")
