"""Text files that people write, read whole; each fault is one sentence."""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError

MAX_BYTES = 1 << 20


def read_text(path: Path, expected: str, *, most: int = MAX_BYTES) -> str:
    """The text of a file, without the byte order mark that Windows editors write.

    Raises:
        InputError: it cannot be read, has more than `most` bytes, or is not UTF-8; names the path and what is expected.
    """
    try:
        return read_bytes(path, expected, most=most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8, expected {expected}") from None


def read_bytes(path: Path, expected: str, *, most: int = MAX_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        InputError: it cannot be read, or has more than `most` bytes; names the path and what was expected.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected {expected}") from None
    if len(data) > most:
        raise InputError(f"{path}: is larger than {most} bytes, expected {expected}")
    return data
