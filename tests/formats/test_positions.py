from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.positions import read_positions


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("photo,x,y,z\na.jpg,1,2,3\nb.jpg,4,5,6.5\n", ""),
        ("Image; pan; X_mm; Y_mm; Z_mm\na.jpg; 7; 1; 2; 3\nb.jpg; 8; 4; 5; 6.5", "mm"),
        ("z (m)\tx (m)\ty (m)\tfilename\n3\t1\t2\ta.jpg\r\n6.5\t4\t5\tb.jpg\r\n", "m"),
        ("\ufeffname,x[cm],y[cm],z[cm]\na.jpg,1,2,3\nb.jpg,4,5,6.5\n", "cm"),
    ],
)
def test_tables(tmp_path: Path, text: str, unit: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    names, xyz, stated = read_positions(path)
    assert (names, stated) == (["a.jpg", "b.jpg"], unit)
    np.testing.assert_array_equal(xyz, [[1, 2, 3], [4, 5, 6.5]])


def test_json_of_a_robot(tmp_path: Path) -> None:
    place = {"x_mm": 75.5, "y_mm": 375, "z_mm": 80, "pan_deg": 270}
    views = [{"file": f"images/{name}.jpg", **place} for name in "ab"]
    (tmp_path / "poses.json").write_text(json.dumps({"note": "", "views": views}))
    names, xyz, unit = read_positions(tmp_path / "poses.json")
    assert (names, unit) == (["images/a.jpg", "images/b.jpg"], "mm")
    np.testing.assert_array_equal(xyz, [[75.5, 375, 80]] * 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no positions"),
        ("photo,x,y,z\n", "holds no positions"),
        ("photo,x,y\na,1,2\n", "found the columns photo, x, y; expected photo, x, y, z"),
        ("1,2,3\n4,5,6\n", "expected photo, x, y, z"),
        ("photo,x_mm,y_mm,z_m\na,1,2,3\n", "different units"),
        ("photo,x,y,z\na,1,2,three\n", "z of a is 'three', expected a number"),
        ("photo,x,y,z\na,1,2,nan\n", "expected a number"),
        ("photo,x,y,z\na,1,2\n", "z of a is None, expected a number"),
        ("photo,x,y,z\na,1,2,3\na,1,2,3\n", "photo a has two positions"),
        ("photo,x,y,z\n,1,2,3\n", "position 0 has no photo"),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_positions(tmp_path / "log.csv")


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_positions(tmp_path / "nowhere.csv")
    (tmp_path / "log.csv").write_bytes(b"photo,x\xff,y,z\n")
    with pytest.raises(InputError, match="is not UTF-8, expected a table of positions"):
        read_positions(tmp_path / "log.csv")
    (tmp_path / "log.json").write_text('{"views": [3]}')
    with pytest.raises(InputError, match="views"):
        read_positions(tmp_path / "log.json")
