"""Replace on finish: a file or folder appears complete under its name, or not at all.

What is being written has a temporary name beside its place, `.<name>.<process>.partial`. A process that is killed
leaves that behind, and never a part under the final name.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SUFFIX = ".partial"
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux; paths are absolute or start where the process runs


def is_partial(path: Path) -> bool:
    """Whether a path is what an unfinished write left behind."""
    return path.name.startswith(".") and path.name.endswith(SUFFIX)


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` make a file under a temporary name, then move it to `path`.

    A reader, or a run that was killed at any moment, finds the old content or the new one. The folder must exist.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    partial = _beside(path)
    try:
        write(partial)
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text_whole(path: Path, text: str) -> None:
    """Write UTF-8 text with "\\n" at the ends of lines on every system; see `write_whole`."""
    write_whole(path, lambda partial: partial.write_text(text, encoding="utf-8", newline="\n"))


@contextmanager
def folder_whole(place: Path) -> Iterator[Path]:
    """A new folder to write into; moved to `place` when the block ends, or deleted when it raises.

    A folder that is at `place` stays until the new one is complete, and is deleted then.

    Raises:
        OSError: the folder cannot be made or moved.
    """
    place = place.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    partial = _beside(place)
    shutil.rmtree(partial, ignore_errors=True)  # of a process that had our number, and was killed
    partial.mkdir()
    try:
        yield partial
        _move(partial, place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}{SUFFIX}")


def _move(folder: Path, place: Path) -> None:
    """Move a folder to a place that may be taken; what was there is deleted after that, or stays if it fails."""
    if not place.exists():
        folder.rename(place)
    elif _exchange(folder, place):
        shutil.rmtree(folder, ignore_errors=True)
    else:
        _move_in_two_steps(folder, place)


def _exchange(first: Path, second: Path) -> bool:
    """Let two paths change names at once, so that neither name is ever missing; False where the system cannot."""
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    if renameat2 is None:
        return False
    return bool(renameat2(AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second), RENAME_EXCHANGE) == 0)


def _move_in_two_steps(folder: Path, place: Path) -> None:
    """The name is missing for a moment: a process that is killed then leaves both folders under temporary names."""
    earlier = place.with_name(f".{place.name}.{os.getpid()}.earlier{SUFFIX}")
    place.rename(earlier)
    try:
        folder.rename(place)
    except BaseException:  # Ctrl-C, too
        if not place.exists():
            earlier.rename(place)
        raise
    shutil.rmtree(earlier, ignore_errors=True)
