"""HEIC photos: a file of 64 x 48 pixels whose quadrants are red, green, blue and white, to be turned by 90 degrees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.heic import find_turn
from mvseg.formats.image_file import read_image_size, read_orientation, read_rgb
from mvseg.poses.photo_files import copy_photos

TURNED = (Path(__file__).parent / "examples" / "turned.heic").read_bytes()
TURN = b"irot\x03"  # three quarters anticlockwise
COLOURS = np.array([[[200, 30, 30], [30, 160, 30]], [[30, 30, 200], [220, 220, 220]]])


def test_the_turn_is_that_of_the_container() -> None:
    for quarters, orientation in enumerate((1, 8, 3, 6)):
        assert find_turn(TURNED.replace(TURN, TURN[:4] + bytes([quarters]))) == orientation
    with pytest.raises(InputError, match="a HEIC file that mirrors its image"):
        find_turn(TURNED.replace(b"irot", b"imir"))
    with pytest.raises(InputError, match="a damaged HEIC file, without the part iprp"):
        find_turn(TURNED.replace(b"iprp", b"free"))


@pytest.mark.parametrize("quarters", range(4))
def test_pixels_are_not_turned(quarters: int, tmp_path: Path) -> None:
    """Whatever EXIF says: it asks for orientation 6 in each of these files."""
    pytest.importorskip("pi_heif", reason="pi_heif is not installed: pip install 'mvseg[heic]'")
    path = tmp_path / "photo.heic"
    path.write_bytes(TURNED.replace(TURN, TURN[:4] + bytes([quarters])))
    assert read_image_size(path) == (64, 48)
    assert read_orientation(path) == (1, 8, 3, 6)[quarters]
    pixels = read_rgb(path, (64, 48))
    assert pixels.shape == (48, 64, 3)
    assert np.abs(pixels[12::24, 16::32].astype(int) - COLOURS).max() < 5
    (photo,) = copy_photos(tmp_path, ["photo.heic"], tmp_path / "images")  # upright, for `mvseg pose`
    upright = np.rot90(COLOURS, quarters)
    width, height = (48, 64) if quarters % 2 else (64, 48)
    assert (photo.name, photo.size, photo.optics) == ("photo.jpg", (width, height), "phone")
    copy = read_rgb(tmp_path / "images" / "photo.jpg")
    assert np.abs(copy[height // 4 :: height // 2, width // 4 :: width // 2].astype(int) - upright).max() < 12
    assert read_orientation(tmp_path / "images" / "photo.jpg") == 1
