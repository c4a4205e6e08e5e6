"""Images are decoded whole or not at all; OpenCV's own reader is the oracle for whole ones."""

from __future__ import annotations

import ntpath
import os
import struct
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from mvseg.errors import InputError
from mvseg.formats import image_file
from mvseg.formats.image_file import file_name_problem, read_image, read_image_size, read_rgb, sensor_bits, write_png
from mvseg.formats.label_png import read_label_png

AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def smooth_picture(height: int = 90, width: int = 120) -> np.ndarray:
    rng = np.random.default_rng(4)
    return cv2.GaussianBlur(rng.integers(0, 255, (height, width, 3), dtype=np.uint8), (0, 0), 2)


def encode(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, smooth_picture(), options)[1].tobytes()


def save(mode: str, kind: str, **options: object) -> bytes:
    """The picture by Pillow's writer."""
    file = BytesIO()
    Image.fromarray(smooth_picture()).convert(mode).save(file, kind, **options)
    return file.getvalue()


ORIENTED = Image.Exif()
ORIENTED[274] = 6  # turned by 90 degrees
JPEGS = {
    "baseline": encode(".jpg"),
    "progressive": encode(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart marks": encode(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}
# A preview inside of an APP1 segment, as cameras write it: it has an end mark of its own.
PREVIEW = b"Exif\0\0" + JPEGS["baseline"]
WITH_PREVIEW = b"\xff\xd8\xff\xe1" + (len(PREVIEW) + 2).to_bytes(2, "big") + PREVIEW + JPEGS["baseline"][2:]
SIXTEEN_BITS = np.arange(5000, dtype=np.uint16).reshape(50, 100) * 13
WHOLE = JPEGS | {
    "preview": WITH_PREVIEW,
    "oriented": save("RGB", "JPEG", exif=ORIENTED),
    "grey jpeg": save("L", "JPEG"),
    "png": encode(".png"),
    "16-bit png": cv2.imencode(".png", SIXTEEN_BITS)[1].tobytes(),
    "16-bit colour png": cv2.imencode(".png", smooth_picture().astype(np.uint16) * 250)[1].tobytes(),
    "16-bit tiff": cv2.imencode(".tif", SIXTEEN_BITS // 256 * 256)[1].tobytes(),  # OpenCV rounds, Pillow cuts
    "png with alpha": save("RGBA", "PNG"),
    "grey png with alpha": save("LA", "PNG"),
    "black and white png": save("1", "PNG"),
    "palette png": save("P", "PNG"),
    "transparent palette png": save("P", "PNG", transparency=bytes(range(250))),
    "bmp": encode(".bmp"),
    "tiff": encode(".tif"),
    "jpeg in tiff": save("RGB", "TIFF", compression="jpeg"),
    "webp": save("RGB", "WEBP", lossless=True),
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_give_the_pixels_of_opencv(name: str, tmp_path: Path) -> None:
    (tmp_path / "image").write_bytes(WHOLE[name])
    image = read_rgb(tmp_path / "image")
    assert image.flags.writeable  # torch.from_numpy warns of others
    np.testing.assert_array_equal(image[..., ::-1], cv2.imread(str(tmp_path / "image"), AS_STORED))


@pytest.mark.parametrize("name", WHOLE)
def test_the_head_tells_the_size_and_the_bits(name: str, tmp_path: Path) -> None:
    (tmp_path / "image").write_bytes(WHOLE[name])
    image = read_image(tmp_path / "image")
    assert read_image_size(tmp_path / "image") == image.size
    assert sensor_bits(tmp_path / "image") == (16 if name.startswith("16-bit") else 8)
    (tmp_path / "image").write_bytes(WHOLE[name][:7])
    with pytest.raises(InputError):
        read_image_size(tmp_path / "image")
    with pytest.raises(InputError, match="No such file"):
        read_image_size(tmp_path / "absent")


def test_a_film_behind_a_jpeg_does_no_harm_and_cmyk_keeps_its_colours(tmp_path: Path) -> None:
    (tmp_path / "image.jpg").write_bytes(JPEGS["baseline"] + b"ftyp" * 50)
    np.testing.assert_array_equal(read_rgb(tmp_path / "image.jpg")[..., ::-1], cv2.imread(str(tmp_path / "image.jpg")))
    (tmp_path / "image.jpg").write_bytes(save("CMYK", "JPEG", quality=98))
    difference = read_rgb(tmp_path / "image.jpg").astype(int) - smooth_picture()
    assert np.abs(difference).mean() < 3


@pytest.mark.parametrize("name", WHOLE)
def test_cut_files_are_refused_wherever_they_are_cut(name: str, tmp_path: Path) -> None:
    path, data = tmp_path / "image", WHOLE[name]
    end = len(data) - (4 if "png" in name else 0)  # the checksum of the end
    for length in [*range(0, end, 1 + len(data) // 60), *range(end - 20, end)]:
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            read_image(path)


def test_png_with_one_wrong_bit_is_refused(tmp_path: Path) -> None:
    data = bytearray(WHOLE["png"])
    data[len(data) // 2] ^= 4
    (tmp_path / "image.png").write_bytes(data)
    with pytest.raises(InputError, match="it is cut short, or a checksum is wrong"):
        read_image(tmp_path / "image.png")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is not a JPEG, PNG, TIFF, BMP, WebP or HEIC file"),
        (b"hello", "it is not a JPEG, PNG, TIFF, BMP, WebP or HEIC file"),
        (b"%!PS-Adobe-3.0 EPSF-3.0", "it is not a JPEG, PNG, TIFF, BMP, WebP or HEIC file"),
        (b"\xff\xd8", "."),
        (b"\x89PNG\r\n\x1a\n", "it is cut short"),
        (b"RIFF0000WAVE", "."),
        (b"II*\0" + b"\xff" * 40, "."),
    ],
)
def test_what_is_no_image_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_image(tmp_path / "image.png")


def test_a_folder_and_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Is a directory"):
        read_image(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        read_image(tmp_path / "absent.png")


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.int16])
def test_floats_and_signed_numbers_are_no_photo(dtype: type, tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "image.tif"), np.ones((4, 6), dtype))
    with pytest.raises(InputError, match="its pixels are signed or 32-bit numbers, expected 8 or 16 bits without sign"):
        read_rgb(tmp_path / "image.tif")


@pytest.mark.parametrize("name", ["baseline", "png", "bmp"])
def test_pillows_limit_on_pixels_gives_way_to_ours(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With limits of some thousand pixels in place of 90 and 1074 megapixels; Pillow would warn, or refuse the file."""
    (tmp_path / "image").write_bytes(WHOLE[name])
    for limit in (120 * 90 - 1, 3000):
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        assert read_rgb(tmp_path / "image").shape == (90, 120, 3)
        assert limit == Image.MAX_IMAGE_PIXELS
    monkeypatch.setattr(image_file, "MAX_PIXELS", 9000)
    with pytest.raises(InputError, match="it is 120 x 90 pixels, expected at most 9000 in all"):
        read_image(tmp_path / "image")


def test_colours_are_written_as_rgb(tmp_path: Path) -> None:
    write_png(tmp_path / "image.png", np.full((3, 5, 3), (200, 100, 0), np.uint8))
    assert read_rgb(tmp_path / "image.png")[1, 1].tolist() == [200, 100, 0]
    assert cv2.imread(str(tmp_path / "image.png"))[1, 1].tolist() == [0, 100, 200]  # OpenCV reads BGR


def test_file_names_that_lead_out_or_nowhere() -> None:
    assert all(map(file_name_problem, ["../a.jpg", "a/../../b.jpg", "/a.jpg", "", ".", "a\0.jpg"]))
    assert not any(map(file_name_problem, ["a.jpg", "./a/../b.jpg", "more/a..b.jpg"]))


@pytest.mark.parametrize("file", ["../a.jpg", "/a.jpg", "C:/a.jpg", "C:a.jpg", "\\\\server\\share\\a.jpg"])
def test_file_names_that_lead_out_on_windows(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "path", ntpath)
        patch.setattr(os, "sep", "\\")
        assert file_name_problem(file) == "the file name leads out of the scene folder"
        assert file_name_problem("images/a.jpg") is None


@pytest.fixture
def bomb(tmp_path: Path) -> Path:
    """A small PNG file that claims 32,000 x 32,000 pixels. (1 MB is enough to hold them all, if they are black.)"""
    path = tmp_path / "bomb.png"
    header = struct.pack(">IIBBBBB", 32_000, 32_000, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(100_000))), (b"IEND", b"")]
    checked = [(data, kind + data, zlib.crc32(kind + data)) for kind, data in chunks]
    parts = [struct.pack(">I", len(data)) + chunk + struct.pack(">I", checksum) for data, chunk, checksum in checked]
    path.write_bytes(image_file.PNG_START + b"".join(parts))
    return path


def test_a_photo_with_a_hole_behind_it_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "hole.png"
    Image.new("RGB", (40, 30)).save(path)
    with path.open("rb+") as file:
        file.truncate(3 << 30)
    with pytest.raises(InputError, match="it is a file of 3221225472 bytes, expected at most"):
        read_image(path, (40, 30))


def test_a_bomb_is_never_decoded(bomb: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(image: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(PngImageFile, "load", refuse)
    with pytest.raises(InputError, match="it is 32000 x 32000 pixels, expected at most 268435456"):
        read_image(bomb)
    with pytest.raises(image_file.WrongSize, match="32000 x 32000, its camera says 640 x 480"):
        read_image(bomb, (640, 480))
    path = bomb.with_name("deep.png")
    data = bomb.read_bytes()
    start = data[12:24] + b"\x10" + data[25:29]  # 16 bits, which are looked at before the photo is read
    path.write_bytes(data[:12] + start + zlib.crc32(start).to_bytes(4, "big") + data[33:])
    assert sensor_bits(path, (640, 480)) == 8
    with pytest.raises(InputError, match=r"bomb\.png: the mask is 32000 x 32000, its camera says 640 x 480"):
        read_label_png(bomb, 640, 480)
