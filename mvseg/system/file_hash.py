"""What is in a file or a folder, as one number."""

from __future__ import annotations

import errno
import hashlib
from pathlib import Path


def hash_files(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path.

    Raises:
        OSError: it cannot be read; or it is a device or a pipe, which may have no end.
    """
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        lines = [f"{hash_files(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is neither a file nor a folder", str(path))
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
