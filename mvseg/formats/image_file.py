"""Image files: decoded whole or not at all, by Pillow.

Pillow refuses truncated files. It does not detect a flipped bit in a PNG, so the checksums of PNG files are verified
here. Orientation tags are ignored in every format, TIFF's own and HEIC's included: rows and columns are those that the
file stores, as COLMAP reads them, to which cameras and masks refer.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from PIL import Image, ImageOps
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from mvseg.errors import InputError
from mvseg.formats.heic import BRANDS, TURN, open_heic
from mvseg.formats.heic import SUFFIXES as HEIC_SUFFIXES

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", *HEIC_SUFFIXES)
MAX_SIDE = 1 << 20  # limit: pixels
MAX_PIXELS = 1 << 28  # limit: more than any camera has; a file of 1 MB may claim, and decode to, a thousand million
PIXEL_BYTES, MARGIN_BYTES = 16, 1 << 26  # limit: of a file, per pixel, and of its other parts
GREY = 2  # chosen: largest difference between the channels of a grey photo
ORIENTATION = 0x0112  # definition: EXIF tag, and TIFF's
BACK = {6: 8, 8: 6}  # the orientation that undoes another; the others undo themselves
EXPOSURE_BLOCK, SECONDS, APERTURE, ISO = 0x8769, 0x829A, 0x829D, 0x8827  # definition: EXIF tags
BITS_PER_SAMPLE = 0x0102  # definition: TIFF tag

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


class WrongSize(InputError):
    """An image of another size than its camera has; the message begins with its own: "640 x 480, its camera ..."."""


def read_image(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """Decode a JPEG, PNG, TIFF, BMP, WebP or HEIC file, recognised by its content, into one of Pillow's modes; the
    first image of several.

    Raises:
        WrongSize: it is not of `size` (width, height), as stored; it is not decoded.
        InputError: the file cannot be opened, is no such image, is cut short or damaged, or has more than 2^28 pixels.
            The message is a reason, without the file's name.
    """
    with _any_fault():
        with path.open("rb") as file:
            reader = _find_reader(file)
        most = MARGIN_BYTES + PIXEL_BYTES * (MAX_PIXELS if size is None else size[0] * size[1])
        if path.stat().st_size > most:
            raise InputError(f"it is a file of {path.stat().st_size} bytes, expected at most {most}")
        data = path.read_bytes()
        if reader is PngImageFile:
            _verify(data)
        image = _open(reader, data)
        width, height = _stored_size(image)
        if size is not None and (width, height) != size:
            turned = " (as it is stored; EXIF turns it for display)" if _orientation_of(image) != 1 else ""
            raise WrongSize(f"{width} x {height}{turned}, its camera says {size[0]} x {size[1]}")
        if width * height > MAX_PIXELS:
            raise InputError(f"it is {width} x {height} pixels, expected at most {MAX_PIXELS} in all")
        turn = _orientation_of(image) if _is_turned_by_decoder(image) else 1
        image.load()
        return _turn_back(image, turn) if turn > 1 else image


def _verify(data: bytes) -> None:
    try:
        PngImageFile(BytesIO(data)).verify()  # the checksums of all chunks, up to the last one
    except (OSError, SyntaxError):
        raise InputError("it is cut short, or a checksum is wrong") from None


def _open(reader: Any, data: bytes) -> ImageFile:
    try:
        return reader(BytesIO(data))
    except SyntaxError as error:
        if reader is TiffImageFile and "pixel mode" in str(error):
            what = "it is a TIFF of numbers of 64 bits, or of half ones"
            raise InputError(f"{what}, expected 8, 16 or 32 bits: labels.astype('uint16')") from None
        raise


def _is_turned_by_decoder(image: ImageFile) -> bool:
    return isinstance(image, TiffImageFile) or TURN in image.info


def _turn_back(image: ImageFile, turn: int) -> Image.Image:
    image.getexif()[ORIENTATION] = BACK.get(turn, turn)
    if not isinstance(image, TiffImageFile):
        return ImageOps.exif_transpose(image)
    ImageOps.exif_transpose(image, in_place=True)  # its tags are asked for later
    return image


def read_image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, as stored, by the header. Raises InputError as `read_image`, as far as that shows."""
    with _any_fault(), path.open("rb") as file:
        return _stored_size(_find_reader(file)(file))


def _stored_size(image: ImageFile) -> tuple[int, int]:
    is_swapped = _is_turned_by_decoder(image) and _orientation_of(image) >= 5  # as it will be turned
    return image.size[::-1] if is_swapped else image.size


@contextmanager
def _any_fault() -> Iterator[None]:
    """Pillow raises almost anything on a damaged file: InputError of it, with a reason."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(reason or type(error).__name__) from None


def _find_reader(file: IO[bytes]) -> Callable[[IO[bytes]], ImageFile]:
    start = file.read(16)
    file.seek(0)
    if start[4:8] == b"ftyp" and start[8:12] in BRANDS:
        return open_heic
    for magic, reader in READERS:
        if start.startswith(magic):
            return reader
    raise InputError("it is not a JPEG, PNG, TIFF, BMP, WebP or HEIC file")


def read_rgb(path: Path, size: tuple[int, int] | None = None, *, bits: int = 8) -> np.ndarray:
    """(H, W, 3) uint8: the image as RGB, without transparency; of 16 bits, the upper 8.

    16-bit files that hold smaller numbers only, as cameras of 10, 12 or 14 bits write them, give the upper 8 of those;
    see `sensor_bits`. They are taken to use `bits` or more, as the other photos do: a dark photo stays darker. Raises
    InputError as `read_image`, or if pixels are signed or have 32 bits.
    """
    image = read_image(path, size)
    deep = read_deep(path, image)
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
    """Number of bits that an image uses: 8, or 10, 12, 14 or 16 in a file of 16 bits; 8 also for a file that cannot be
    read or has another size (see `read_image`). Only 16-bit files are decoded; the answer is cached until the file
    changes."""
    with suppress(InputError, OSError):
        facts = path.stat()
        return _bits_of_file(path, size, facts.st_mtime_ns, facts.st_size)
    return 8


@lru_cache(maxsize=4096)
def _bits_of_file(path: Path, size: tuple[int, int] | None, modified_ns: int, num_bytes: int) -> int:
    with _any_fault(), path.open("rb") as file:
        head = file.read(26)
        file.seek(0)
        if not _is_deep(head, _find_reader(file)(file)):
            return 8
    deep = read_deep(path, read_image(path, size))
    return 8 if deep is None else _bits_of(deep)


def _bits_of(deep: np.ndarray) -> int:
    highest = int(deep.max(initial=0))
    return next(bits for bits in (10, 12, 14, 16) if highest < 1 << bits)


def _is_deep(head: bytes, image: Image.Image) -> bool:
    """Whether a file, of which these are the first bytes, has 16 bits per channel; Pillow's modes do not tell."""
    if isinstance(image, TiffImageFile):
        return bool(image.tag_v2.get(BITS_PER_SAMPLE, (8,))[0] == 16)
    return isinstance(image, PngImageFile) and head[24:25] == b"\x10"


def read_deep(path: Path, image: Image.Image) -> np.ndarray | None:
    """(H, W) or (H, W, 3) uint16, RGB, of an image of 16 bits; None of others. Pillow reduces colours to 8 bits, so
    OpenCV reads them, after Pillow has verified the file."""
    if image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16)
    if image.mode not in ("RGB", "RGBA", "LA") or not isinstance(image, (PngImageFile, TiffImageFile)):
        return None
    data = path.read_bytes()
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if _is_deep(data, image) else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[:2] != (image.height, image.width):
        return None
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., 2::-1])


def is_grey(pixels: np.ndarray) -> bool:
    """Whether a photo (H, W, 3) uint8 is grey; differences of one or two levels, as JPEG makes, do not count."""
    return bool((np.ptp(pixels, axis=2) <= GREY).all())


def read_orientation(path: Path) -> int:
    """How viewers are asked to rotate or mirror an image, 1 to 8 as in EXIF; 1 (not at all) where nothing is said."""
    with suppress(InputError), _any_fault(), path.open("rb") as file:  # a damaged EXIF block says nothing
        return _orientation_of(_find_reader(file)(file))
    return 1


def is_turned(path: Path) -> bool:
    """Whether viewers are asked to rotate or mirror an image."""
    return read_orientation(path) != 1


def _orientation_of(image: ImageFile) -> int:
    if isinstance(image, TiffImageFile):
        tag = image.tag_v2.get(ORIENTATION)
    elif isinstance(image, PngImageFile):  # whose own method decodes it, to find a chunk behind the pixels
        exif = Image.Image.getexif(image)
        if ORIENTATION not in exif and image.fp is not None:
            at = image.fp.tell()
            exif.load(_find_chunk(image.fp, b"eXIf"))
            image.fp.seek(at)
        tag = exif.get(ORIENTATION)
    else:
        tag = image.info[TURN] if TURN in image.info else image.getexif().get(ORIENTATION)
    return tag if isinstance(tag, int) and 1 <= tag <= 8 else 1


def _find_chunk(file: IO[bytes], kind: bytes) -> bytes:
    file.seek(len(PNG_START))
    while len(head := file.read(8)) == 8:
        length = int.from_bytes(head[:4])
        if head[4:] == kind:
            return file.read(length)
        file.seek(length + 4, os.SEEK_CUR)
    return b""


def turn_upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """(H, W, 3) uint8 as viewers show it; see `read_orientation`."""
    image = Image.fromarray(pixels)
    image.getexif()[ORIENTATION] = orientation
    return np.asarray(ImageOps.exif_transpose(image))


def read_exposure(path: Path) -> float:
    """Exposure of a JPEG by EXIF, in stops: log2(seconds x ISO / f-number^2); the same object in the same light is
    brighter where it is larger. NaN if EXIF lacks one of the three."""
    with suppress(InputError), _any_fault(), path.open("rb") as file:  # as `read_orientation`
        said = JpegImageFile(file).getexif().get_ifd(EXPOSURE_BLOCK)
        return math.log2(float(said[SECONDS]) * float(said[ISO]) / float(said[APERTURE]) ** 2)
    return math.nan


def describe_turn(path: Path) -> str:
    """Note on a tag that turns a photo, as the end of a sentence about sizes that do not fit; "" if none does."""
    return f"; EXIF turns {path.name} for display, its masks must be of the pixels as stored" if is_turned(path) else ""


def file_name_problem(file: str, *, folder: str = "the scene folder") -> str | None:
    """Fault of an image's path relative to its folder, as the end of a sentence; None if it is valid."""
    path = os.path.normpath(file)
    starts_elsewhere = os.path.isabs(path) or path.startswith(os.sep) or os.path.splitdrive(path)[0]  # on Windows, too
    if starts_elsewhere or path.split(os.sep)[0] == "..":
        return f"the file name leads out of {folder}"
    return "this is not the name of a file" if path == "." or "\0" in path else None


def write_png(path: Path, image: np.ndarray) -> None:
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB. Raises OSError if the file cannot be written."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def encode_jpeg(image: np.ndarray, *, quality: int) -> bytes:
    """The bytes of a JPEG file of (H, W, 3) uint8 RGB; `quality` from 1 to 95."""
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    return buffer.getvalue()
