"""Image files: decoded whole or not at all, by Pillow.

Pillow refuses files that are cut short. It does not see a bit that flipped in a PNG, so the checksums of PNG files are
verified here. EXIF orientation is ignored: rows and columns are those that the file stores, to which cameras and masks
refer. (The orientation tag of a TIFF file belongs to the format, and Pillow applies it.)
"""

from __future__ import annotations

import os
import struct
import zlib
from io import BytesIO
from pathlib import Path
from threading import Lock

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
MAX_SIDE = 1 << 20  # pixels
ORIENTATION = 0x0112  # EXIF tag
MAX_PIXELS = 1 << 30
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


def read_image(path: Path) -> Image.Image:
    """Decode a JPEG, PNG, TIFF, BMP or WebP file, told apart by its content; the first image of several.

    Returns:
        The pixels as the file has them, in one of Pillow's modes.

    Raises:
        InputError: the file cannot be opened, is no such image, is cut short or damaged, or has more than 2^30 pixels.
            The message is a reason, without the file's name.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(error.strerror or "no such file") from None
    reader = next((reader for start, reader in READERS if data.startswith(start)), None)
    if reader is None:
        raise InputError("it is not a JPEG, PNG, TIFF, BMP or WebP file")
    if reader is PngImageFile and not _has_sound_chunks(data):
        raise InputError("it is cut short, or a checksum is wrong")
    try:
        image = reader(BytesIO(data))
        is_too_large = image.width * image.height > MAX_PIXELS
        if not is_too_large:
            _load(image)
    except Exception as error:  # Pillow raises almost anything on a damaged file
        raise InputError(" ".join(str(error).split()) or type(error).__name__) from None
    if is_too_large:
        raise InputError(f"it is {image.width} x {image.height} pixels, expected at most {MAX_PIXELS} in all")
    return image


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) uint8: an image in colour, without transparency, the upper 8 of 16 bits.

    Raises:
        InputError: see `read_image`; or the pixels are signed, or have 32 bits.
    """
    image = read_image(path)
    if image.mode.startswith("I;16"):
        return np.repeat((np.asarray(image) >> 8).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise InputError("its pixels are signed or 32-bit numbers, expected 8 or 16 bits without sign")
    image.info.pop("transparency", None)  # Pillow would look for a colour that stands for it
    try:
        return np.array(image if image.mode == "RGB" else image.convert("RGB"))
    except ValueError as error:
        raise InputError(str(error)) from None


def is_turned(path: Path) -> bool:
    """Whether EXIF asks viewers to turn or mirror a JPEG; other formats are rarely turned so, and not looked at."""
    try:
        with path.open("rb") as file:
            return JpegImageFile(file).getexif().get(ORIENTATION, 1) != 1
    except Exception:  # no JPEG, or a damaged EXIF block: it says nothing
        return False


def file_name_problem(file: str, *, folder: str = "the scene folder") -> str | None:
    """What is wrong with an image's path relative to its folder, as the end of a sentence; None for a sound one."""
    path = os.path.normpath(file)
    if os.path.isabs(path) or path.split(os.sep)[0] == "..":
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
    """Whether a PNG file is there up to its end chunk, each chunk with the right checksum."""
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
