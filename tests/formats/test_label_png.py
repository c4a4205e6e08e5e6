"""Label PNGs: what was written comes back, and nothing else passes for labels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png, write_label_png
from scene_folders import write_image


def test_labels_of_16_and_8_bits_come_back(tmp_path: Path) -> None:
    labels = np.arange(65536, dtype=np.int64).reshape(128, 512)
    path = tmp_path / "new" / "folder" / "labels.png"
    write_label_png(path, labels)
    back = read_label_png(path, 512, 128)
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, labels)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), labels)
    labels = np.array([[0, 1, 2], [200, 254, 255]], np.uint8)
    write_image(tmp_path / "labels.png", labels)
    np.testing.assert_array_equal(read_label_png(tmp_path / "labels.png", 3, 2), labels)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 6, 3), np.uint8), "has 3 colour channels, expected a label PNG with a single channel"),
        (np.zeros((4, 6, 4), np.uint8), "has 4 colour channels"),
        (np.zeros((4, 5), np.uint16), "the mask is 5 x 4, its camera says 6 x 4"),
        (np.zeros((6, 4), np.uint16), "the mask is 4 x 6, its camera says 6 x 4"),
    ],
)
def test_other_images_are_refused(image: np.ndarray, message: str, tmp_path: Path) -> None:
    write_image(tmp_path / "labels.png", image)
    with pytest.raises(InputError, match=rf"labels.png: {message}"):
        read_label_png(tmp_path / "labels.png", 6, 4)


def test_floats_are_refused(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "float.tif"), np.zeros((4, 6), np.float32))
    with pytest.raises(InputError, match=r"float.tif: holds signed or 32-bit numbers, expected 8 or 16 bits"):
        read_label_png(tmp_path / "float.tif", 6, 4)


def test_palette_pngs_give_their_indices(tmp_path: Path) -> None:
    """Of 8, 4 and 1 bits, also where two indices have one colour, or a colour is transparent."""
    for colors, name in ((256, "8"), (16, "4"), (2, "1")):
        labels = (np.arange(24).reshape(4, 6) % colors).astype(np.uint8)
        image = Image.fromarray(labels)
        image.putpalette([value for color in range(colors) for value in (color // 2 * 7 % 256, 90, 30)])
        image.save(tmp_path / f"{name}.png", transparency=0)
        np.testing.assert_array_equal(read_label_png(tmp_path / f"{name}.png", 6, 4), labels)
