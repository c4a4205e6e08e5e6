"""Image files: decoded whole or not at all, by Pillow.

Pillow refuses truncated files. It does not detect a flipped bit in a PNG, so the checksums of PNG files are verified
here. EXIF orientation is ignored: rows and columns are those that the file stores, to which cameras and masks refer.
(The orientation tag of a TIFF file belongs to the format, and Pillow applies it.)
"""

from __future__ import annotations

import os
import struct
import zlib
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import cv2
import numpy as np
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from mvseg.errors import InputError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
PHONE_SUFFIXES = (".heic", ".heif")  # known by name, to say what to do with them
MAX_SIDE = 1 << 20  # pixels
MAX_PIXELS = 1 << 28  # more than any camera has; a file of 1 MB may claim, and decode to, a thousand million
GREY = 2  # largest difference between the channels of a grey photo
ORIENTATION = 0x0112  # EXIF tag
BITS_PER_SAMPLE = 0x0102  # TIFF tag
LARGE = 1 << 26  # pixels; Pillow's own limit lies above

PNG_START = b"\x89PNG\r\n\x1a\n"
# These formats only: among Pillow's others is one (EPS) that runs a program.
READERS: tuple[tuple[bytes, type[ImageFile]], ...] = (
    (b"\xff\xd8", JpegImageFile),
    (PNG_START, PngImageFile),
    (b"II", TiffImageFile),
    (b"MM", TiffImageFile),
    (b"BM", BmpImageFile),
    (b"RIFF", WebPImageFile),
)
_pillow_limit = Lock()


class WrongSize(InputError):
    """An image of `width` x `height` pixels where another size was expected."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(f"it is {width} x {height}")
        self.width, self.height = width, height


def read_image(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """Decode a JPEG, PNG, TIFF, BMP or WebP file, recognised by its content; the first image of several.

    Args:
        path: the file.
        size: width and height that the image must have, in this or the other order; another one is not decoded.

    Returns:
        The pixels as the file has them, in one of Pillow's modes.

    Raises:
        WrongSize: an image of another size.
        InputError: the file cannot be opened, is no such image, is cut short or damaged, or has more than 2^28 pixels.
            The message is a reason, without the file's name.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(error.strerror or "no such file") from None
    reader = next((reader for start, reader in READERS if data.startswith(start)), None)
    if reader is None:
        raise InputError(no_image_message(data[:16]))
    if reader is PngImageFile and not _has_sound_chunks(data):
        raise InputError("it is cut short, or a checksum is wrong")
    try:
        image = reader(BytesIO(data))
        is_too_large = image.width * image.height > MAX_PIXELS
        is_of_size = size is None or sorted(image.size) == sorted(size)  # a TIFF may be turned when it is decoded
        if is_of_size and not is_too_large:
            _load(image)
    except Exception as error:  # Pillow raises almost anything on a damaged file
        raise InputError(" ".join(str(error).split()) or type(error).__name__) from None
    if not is_of_size:
        raise WrongSize(image.width, image.height)
    if is_too_large:
        raise InputError(f"it is {image.width} x {image.height} pixels, expected at most {MAX_PIXELS} in all")
    return image


def read_image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, as stored; only the header of the file is read.

    Raises:
        InputError: as `read_image`, as far as the header shows.
    """
    try:
        with path.open("rb") as file:
            start = file.read(16)
            reader = next((reader for magic, reader in READERS if start.startswith(magic)), None)
            if reader is None:
                raise InputError(no_image_message(start))
            file.seek(0)
            width, height = reader(file).size
    except OSError as error:
        raise InputError(error.strerror or "no such file") from None
    except InputError:
        raise
    except Exception as error:  # Pillow raises almost anything on a damaged file
        raise InputError(" ".join(str(error).split()) or type(error).__name__) from None
    return width, height


def no_image_message(start: bytes) -> str:
    """Why a file is not a supported image, from its first bytes."""
    if start[4:8] == b"ftyp" and start[8:12] in (b"heic", b"heix", b"mif1", b"msf1", b"hevc", b"heim", b"avif"):
        return "it is a HEIC file, expected JPEG, PNG, TIFF, BMP or WebP: convert it without turning or scaling it"
    return "it is not a JPEG, PNG, TIFF, BMP or WebP file"


def read_rgb(path: Path, size: tuple[int, int] | None = None, *, bits: int = 8) -> np.ndarray:
    """(H, W, 3) uint8: the image as RGB, without transparency; of 16 bits, the upper 8.

    Files of 16 bits that hold smaller numbers only, as cameras of 10, 12 or 14 bits write them, give the upper 8 of
    those; see `sensor_bits`.

    Args:
        path: the file.
        size: see `read_image`.
        bits: least number of bits that a 16-bit file is taken to use: that of the other photos, so that a dark photo
            stays darker than they are.

    Raises:
        InputError: see `read_image`; or the pixels are signed, or have 32 bits.
    """
    image = read_image(path, size)
    deep = _read_deep(path, image)
    if deep is not None:
        bits = max(bits, _bits_of(deep))
        if bits < 16 or deep.ndim == 2:
            pixels = (deep >> (bits - 8)).astype(np.uint8)
            return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise InputError("its pixels are signed or 32-bit numbers, expected 8 or 16 bits without sign")
    image.info.pop("transparency", None)  # Pillow would look for a colour that stands for it
    try:
        return np.array(image if image.mode == "RGB" else image.convert("RGB"))
    except ValueError as error:
        raise InputError(str(error)) from None


def sensor_bits(path: Path, size: tuple[int, int] | None = None) -> int:
    """How many bits the numbers of an image use: 8, or 10, 12, 14 or 16 in a file of 16 bits.

    8-bit files are recognised by their headers; others are decoded. For `size` see `read_image`.

    Raises:
        InputError: see `read_image`.
    """
    with path.open("rb") as file:
        head = file.read(26)
        if head.startswith((b"II", b"MM")):
            is_deep = _tiff_bits(file) == 16
        else:
            is_deep = head.startswith(PNG_START) and head[24:25] == b"\x10"
    if not is_deep:
        return 8
    deep = _read_deep(path, read_image(path, size))
    return 8 if deep is None else _bits_of(deep)


def known_bits(path: Path, size: tuple[int, int] | None = None) -> int:
    """As `sensor_bits`, cached until the file changes; 8 for one that cannot be read or has another size."""
    try:
        facts = path.stat()
        return _bits_of_file(path, size, facts.st_mtime_ns, facts.st_size)
    except (InputError, OSError):
        return 8


@lru_cache(maxsize=4096)
def _bits_of_file(path: Path, size: tuple[int, int] | None, modified_ns: int, num_bytes: int) -> int:
    return sensor_bits(path, size)


def _tiff_bits(file: BinaryIO) -> int:
    """Bits of a TIFF file's first channel, from its header; 8 if unknown."""
    file.seek(0)
    try:
        return int(TiffImageFile(file).tag_v2.get(BITS_PER_SAMPLE, (8,))[0])
    except Exception:  # Pillow raises almost anything on a damaged file
        return 8


def _bits_of(deep: np.ndarray) -> int:
    highest = int(deep.max(initial=0))
    return next(bits for bits in (10, 12, 14, 16) if highest < 1 << bits)


def _read_deep(path: Path, image: Image.Image) -> np.ndarray | None:
    """(H, W) or (H, W, 3) uint16, RGB, of an image of 16 bits; None of others. Pillow reduces colours to 8 bits, so
    OpenCV reads them, after Pillow has verified the file."""
    if image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16)
    if image.mode not in ("RGB", "RGBA", "LA") or not isinstance(image, (PngImageFile, TiffImageFile)):
        return None
    data = path.read_bytes()
    if isinstance(image, PngImageFile):
        is_deep = data[24:25] == b"\x10"
    else:
        is_deep = image.tag_v2.get(BITS_PER_SAMPLE, (8,))[0] == 16
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if is_deep else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[:2] != (image.height, image.width):
        return None
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., 2::-1])


def is_grey(pixels: np.ndarray) -> bool:
    """Whether a photo (H, W, 3) uint8 is grey; differences of one or two levels, as JPEG makes, do not count."""
    return bool((np.ptp(pixels, axis=2) <= GREY).all())


def is_turned(path: Path) -> bool:
    """Whether EXIF asks viewers to rotate or mirror a JPEG; other formats rarely do, and are not checked."""
    try:
        with path.open("rb") as file:
            return JpegImageFile(file).getexif().get(ORIENTATION, 1) != 1
    except Exception:  # no JPEG, or a damaged EXIF block: it says nothing
        return False


def file_name_problem(file: str, *, folder: str = "the scene folder") -> str | None:
    """What is wrong with an image's path relative to its folder, as the end of a sentence; None if it is valid."""
    path = os.path.normpath(file)
    starts_elsewhere = os.path.isabs(path) or path.startswith(os.sep) or os.path.splitdrive(path)[0]  # on Windows, too
    if starts_elsewhere or path.split(os.sep)[0] == "..":
        return f"the file name leads out of {folder}"
    if path == "." or "\0" in path:
        return "this is not the name of a file"
    return None


def _load(image: ImageFile) -> None:
    """Decode the pixels. Pillow's own limit is one number for the whole process; our larger one replaces it only while
    a large file is decoded."""
    if image.width * image.height < LARGE:
        image.load()
        return
    with _pillow_limit:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            image.load()
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def _has_sound_chunks(data: bytes) -> bool:
    """Whether a PNG file is complete up to its end chunk, each chunk with the right checksum."""
    at, kind = len(PNG_START), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            return False
        length, kind = struct.unpack_from(">I4s", data, at)
        stop = at + 8 + length
        if zlib.crc32(data[at + 4 : stop]).to_bytes(4, "big") != data[stop : stop + 4]:
            return False
        at = stop + 4
    return True


def write_png(path: Path, image: np.ndarray) -> None:
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB.

    Raises:
        OSError: the file cannot be written.
    """
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".png", pixels)
    path.write_bytes(encoded.tobytes())


def encode_jpeg(image: np.ndarray, *, quality: int) -> bytes:
    """The bytes of a JPEG file of (H, W, 3) uint8 RGB; `quality` from 1 to 95."""
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    return buffer.getvalue()
