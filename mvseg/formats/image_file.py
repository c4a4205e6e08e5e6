"""Image files: decoded whole or not at all. OpenCV alone fills what is missing of a cut JPEG with grey."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

JPEG_START, PNG_START = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # not the stuffing and restart marks inside of image data
JPEG_END = b"\xff\xd9"
MAX_SIDE = 1 << 20  # pixels; OpenCV reads no larger image


def read_image(path: Path, flags: int) -> np.ndarray | None:
    """The pixels as `cv2.imread` gives them with these flags; None for a file that cannot be opened, is no image, is
    cut short, or (PNG) fails its checksums."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if not data or (data.startswith(JPEG_START) and not _is_whole_jpeg(data)):
        return None
    if data.startswith(PNG_START) and not _is_whole_png(data):
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # more pixels than OpenCV allows
        return None


def _is_whole_jpeg(data: bytes) -> bool:
    """From segment to segment up to the end mark; previews inside of segments have end marks of their own."""
    at = len(JPEG_START)
    while marker := JPEG_MARKER.search(data, at):
        if marker.group() == JPEG_END:
            return True
        at = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return False


def _is_whole_png(data: bytes) -> bool:
    """From chunk to chunk, with their checksums, up to the end chunk."""
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
