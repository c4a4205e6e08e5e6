"""What is in a file or a folder, as one number."""

from __future__ import annotations

import hashlib
from pathlib import Path


def hash_files(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path."""
    if not path.is_dir():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{hash_files(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()
