"""Images are decoded whole or not at all; OpenCV's own reader is the oracle for whole ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.formats.image_file import read_image, write_png

COLOR = cv2.IMREAD_COLOR


def smooth_picture(height: int = 90, width: int = 120) -> np.ndarray:
    rng = np.random.default_rng(4)
    return cv2.GaussianBlur(rng.integers(0, 255, (height, width, 3), dtype=np.uint8), (0, 0), 2)


def encode(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, smooth_picture(), options)[1].tobytes()


JPEGS = {
    "baseline": encode(".jpg"),
    "progressive": encode(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart marks": encode(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}
# A preview inside of an APP1 segment, as cameras write it: it has an end mark of its own.
PREVIEW = b"Exif\0\0" + JPEGS["baseline"]
WITH_PREVIEW = b"\xff\xd8\xff\xe1" + (len(PREVIEW) + 2).to_bytes(2, "big") + PREVIEW + JPEGS["baseline"][2:]
WHOLE = JPEGS | {
    "preview": WITH_PREVIEW,
    "appended film": JPEGS["baseline"] + b"ftyp" * 50,
    "png": encode(".png"),
    "16-bit png": cv2.imencode(".png", np.arange(5000, dtype=np.uint16).reshape(50, 100))[1].tobytes(),
    "bmp": encode(".bmp"),
    "tiff": encode(".tif"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_give_the_pixels_of_opencv(name: str, tmp_path: Path) -> None:
    path = tmp_path / "image"
    path.write_bytes(WHOLE[name])
    for flags in (COLOR, cv2.IMREAD_UNCHANGED):
        image = read_image(path, flags)
        assert image is not None
        np.testing.assert_array_equal(image, cv2.imread(str(path), flags))


@pytest.mark.parametrize("name", sorted(set(WHOLE) - {"appended film", "bmp", "tiff"}))
def test_cut_files_are_refused_wherever_they_are_cut(name: str, tmp_path: Path) -> None:
    path, data = tmp_path / "image", WHOLE[name]
    for length in [*range(0, len(data), 97), *range(len(data) - 20, len(data))]:
        path.write_bytes(data[:length])
        assert read_image(path, COLOR) is None, length


def test_png_with_one_wrong_bit_is_refused(tmp_path: Path) -> None:
    data = bytearray(WHOLE["png"])
    data[len(data) // 2] ^= 4
    (tmp_path / "image.png").write_bytes(data)
    assert read_image(tmp_path / "image.png", COLOR) is None


@pytest.mark.parametrize("content", [b"", b"hello", b"\xff\xd8", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(content)
    assert read_image(tmp_path / "image.png", COLOR) is None


def test_a_folder_and_nothing_are_refused(tmp_path: Path) -> None:
    assert read_image(tmp_path, COLOR) is None
    assert read_image(tmp_path / "absent.png", COLOR) is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_written_png_reads_back(dtype: type, tmp_path: Path) -> None:
    image = np.arange(24, dtype=dtype).reshape(4, 6) * (2000 if dtype is np.uint16 else 10)
    write_png(tmp_path / "image.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "image.png", cv2.IMREAD_UNCHANGED), image)


def test_colours_are_written_as_rgb(tmp_path: Path) -> None:
    write_png(tmp_path / "image.png", np.full((3, 5, 3), (200, 100, 0), np.uint8))
    assert cv2.imread(str(tmp_path / "image.png"))[1, 1].tolist() == [0, 100, 200]  # OpenCV reads BGR
