"""Content of a file or a folder as one number."""

from __future__ import annotations

import errno
import hashlib
from pathlib import Path

CHUNK = 1 << 20  # limit: bytes that are read at once


def hash_files(path: Path, *, most_bytes: int | None = None) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path. Raises
    OSError if it cannot be read, is a device or a pipe, which may have no end, or has more than `most_bytes`."""
    if path.is_dir():
        lines, remaining = [], most_bytes
        for each in sorted(each for each in path.rglob("*") if each.is_file()):
            lines.append(f"{hash_files(each, most_bytes=remaining)}  {each.relative_to(path).as_posix()}\n")
            remaining = None if remaining is None else remaining - each.stat().st_size
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is neither a file nor a folder", str(path))
    with path.open("rb") as file:
        if most_bytes is None:
            return hashlib.file_digest(file, "sha256").hexdigest()
        digest = hashlib.sha256()
        while block := file.read(min(CHUNK, most_bytes + 1)):  # the sizes of /proc are 0
            most_bytes -= len(block)
            if most_bytes < 0:
                raise OSError(errno.EFBIG, "is larger than expected", str(path))
            digest.update(block)
        return digest.hexdigest()
