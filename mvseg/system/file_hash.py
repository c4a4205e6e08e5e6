"""Content of a file or a folder as one number."""

from __future__ import annotations

import errno
import hashlib
import math
from pathlib import Path

CHUNK = 1 << 20  # limit: bytes that are read at once


def hash_files(path: Path, *, most_bytes: float = math.inf) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path. Raises
    OSError if it cannot be read, is a device or a pipe, which may have no end, or has more than `most_bytes`."""
    if path.is_dir():
        lines = []
        for each in sorted(each for each in path.rglob("*") if each.is_file()):
            lines.append(f"{hash_files(each, most_bytes=most_bytes)}  {each.relative_to(path).as_posix()}\n")
            most_bytes -= each.stat().st_size
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is neither a file nor a folder", str(path))
    digest = hashlib.sha256()
    with path.open("rb") as file:
        if most_bytes == math.inf:
            return hashlib.file_digest(file, "sha256").hexdigest()
        while block := file.read(CHUNK):  # the sizes of /proc are 0
            most_bytes -= len(block)
            if most_bytes < 0:
                raise OSError(errno.EFBIG, "is larger than expected", str(path))
            digest.update(block)
    return digest.hexdigest()
