"""Replace on finish: a file or folder appears complete under its name, or not at all.

What is being written has a temporary name beside its place, `.<name>.<machine>-<random>.partial`, and is locked. A
process that is killed leaves that behind, unlocked, and never a part under the final name; the next write to the same
name deletes it. Numbers of processes would not do: two containers have the same.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import re
import shutil
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mvseg.errors import InputError

if sys.platform != "win32":
    import fcntl


def _machine() -> str:
    """What has locks in common, as far as one can be sure: a disk may be shared, and its locks may be not."""
    try:
        name = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")  # containers share it
    except (OSError, ValueError):
        name = platform.node()
    return f"{zlib.crc32(name.encode()):08x}"


SUFFIX, EARLIER = ".partial", ".earlier"
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux; paths are absolute or start where the process runs
MACHINE = _machine()
LONG_AGO = 24 * 3600  # seconds without a change, after which nobody is writing any more
TAKEN = (errno.ENOTEMPTY, errno.EEXIST)
MOVES = 10_000  # attempts, before a place that other processes keep taking is given up

_begun: set[Path] = set()  # temporary files and folders of this process that may still be there
_locked: set[int] = set()  # handles of what this process has locked


def _let_go() -> None:
    """A process that is forked off (a data loader's) must not hold a lock on when its parent is killed."""
    for handle in _locked:
        os.close(handle)
    _locked.clear()
    _begun.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


def clear_begun() -> None:
    """Delete the temporary files and folders of this process that are still there.

    For the end of a process that a signal stops: its exception may come while another one is being cleared up.
    """
    for partial in [*_begun]:
        _delete(partial)
    _begun.clear()


def resolve_place(place: Path) -> Path:
    """The absolute path of a place that need not exist, without links.

    Raises:
        InputError: its links lead in a circle.
    """
    try:
        place.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(f"{place}: its links lead in a circle, expected a folder or a new name") from None
    return place.resolve()


def is_partial(path: Path) -> bool:
    """Whether a path is what a write has not finished, or never will."""
    return path.name.startswith(".") and path.name.endswith(SUFFIX)


def delete_abandoned(path: Path) -> None:
    """Delete a temporary file or folder unless somebody may still be writing it.

    On this machine the lock tells. Where there are no locks, and on a disk that another machine writes to, whose locks
    may not be seen here, only what has not changed for a day is deleted.
    """
    is_here = f".{MACHINE}-" in path.name
    handle = None
    try:
        if sys.platform != "win32":
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        is_free = None if handle is None else _lock(handle)
        if (is_free and is_here) or (is_free is not False and time.time() - _last_change(path) > LONG_AGO):
            _delete(path)
    except OSError:  # it is gone, or somebody else's
        return
    finally:
        if handle is not None:
            os.close(handle)


def sweep_abandoned(place: Path) -> None:
    """Delete what killed runs left beside `place` while they were writing it.

    One that was killed between the two steps of a move (where the system cannot exchange folders) left nothing at
    `place`: then its earlier folder comes back. To one that is between them now, this is a newer folder at `place`.

    Raises:
        InputError: see `resolve_place`.
    """
    place = resolve_place(place)
    try:
        names = os.listdir(place.parent)
    except OSError:  # it is not there, or not to be read
        return
    ours = re.compile(rf"\.{re.escape(place.name)}\.[0-9a-f]{{8}}-[0-9a-f]{{12}}(\{EARLIER})?\{SUFFIX}")
    for path in [place.parent / name for name in names if ours.fullmatch(name)]:
        if not path.name.endswith(EARLIER + SUFFIX):
            delete_abandoned(path)
        elif os.path.lexists(place):
            _delete(path)
        else:
            with suppress(OSError):  # another process was quicker
                path.rename(place)


@contextmanager
def lock_folder(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Keep other runs out of a folder in which files are added one by one; the lock ends with the process.

    Args:
        folder: must exist.
        wait: wait until no other process works in it.

    Raises:
        InputError: another process works in it, and `wait` is not set.
    """
    if sys.platform == "win32":
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    _locked.add(handle)
    try:
        if _lock(handle, wait=wait) is False:  # not: a disk without locks
            raise InputError(f"{folder}: another run is writing to this folder, expected one at a time")
        yield
    finally:
        _unlock(handle)


def _lock(handle: int, *, wait: bool = False) -> bool | None:
    """Lock an open file or folder. False where it is locked already, None on a disk without locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        return False if error.errno in (errno.EAGAIN, errno.EACCES) else None
    return True


def _unlock(handle: int) -> None:
    if handle in _locked:  # not in a process that was forked off meanwhile
        _locked.discard(handle)
        os.close(handle)


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` make a file under a temporary name, then move it to `path`.

    A reader, or a run that was killed at any moment, finds the old content or the new one. The folder must exist.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    sweep_abandoned(path)
    with _beside(path, lambda partial: partial.touch(exist_ok=False)) as partial:
        write(partial)
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)


def write_text_whole(path: Path, text: str) -> None:
    """Write UTF-8 text with "\\n" at the ends of lines on every system; see `write_whole`."""
    write_whole(path, lambda partial: partial.write_text(text, encoding="utf-8", newline="\n"))


@contextmanager
def folder_whole(place: Path) -> Iterator[Path]:
    """A new folder to write into; moved to `place` when the block ends, or deleted when it raises.

    A folder that is at `place` stays until the new one is complete, and is deleted then. Any number of processes may
    do so at once: the last one to finish wins.

    Raises:
        InputError: see `resolve_place`.
        OSError: the folder cannot be made or moved.
    """
    place = resolve_place(place)
    place.parent.mkdir(parents=True, exist_ok=True)
    sweep_abandoned(place)
    with _beside(place, Path.mkdir) as partial:
        yield partial
        _move(partial, place)


@contextmanager
def _beside(path: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """A new file or folder that is locked, under a temporary name; deleted at the end, if it is still there.

    Raises:
        OSError: as raised inside; it names `path` where it names nothing (a full disk) or the temporary name.
    """
    try:
        partial, handle = _begin(path, make)
        try:
            yield partial
        finally:
            try:
                _delete(partial)
                _begun.discard(partial)
            finally:
                _unlock(handle)
    except OSError as error:
        if error.errno is not None and (error.filename is None or is_partial(Path(str(error.filename)))):
            error.filename = str(path)
        raise


def _begin(path: Path, make: Callable[[Path], None]) -> tuple[Path, int]:
    """Make a file or folder under a new temporary name, and lock it; on Windows without a lock, and no handle (-1)."""
    while True:
        partial = _temporary(path)
        _begun.add(partial)
        make(partial)
        handle = -1
        if sys.platform == "win32":
            return partial, handle
        with suppress(FileNotFoundError):
            handle = os.open(partial, os.O_RDONLY)
            _locked.add(handle)
            if _lock(handle) is not False and partial.exists():
                return partial, handle
        _begun.discard(partial)  # another process took it for abandoned, before it was locked
        _unlock(handle)


def _temporary(path: Path, kind: str = "") -> Path:
    """A name that nobody else uses."""
    return path.with_name(f".{path.name}.{MACHINE}-{os.urandom(6).hex()}{kind}{SUFFIX}")


def _last_change(path: Path) -> float:
    """When a file, or anything in a folder, changed last; seconds since 1970."""
    return max(each.lstat().st_mtime for each in (path, *path.rglob("*")))


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _move(folder: Path, place: Path) -> None:
    """Move a folder to a place that may be taken, and may come and go; the earlier folder is then at the old name."""
    for _ in range(MOVES):
        try:
            if not os.path.lexists(place):
                folder.rename(place)
            elif not _exchange(folder, place):
                _move_in_two_steps(folder, place)
            return
        except OSError as error:
            if error.errno not in TAKEN and not (
                error.errno == errno.ENOENT and folder.exists()  # somebody took the earlier one away
            ):
                raise
    raise OSError(errno.EBUSY, "other processes keep writing it", str(place))


def _exchange(first: Path, second: Path) -> bool:
    """Let two paths change names at once, so that neither name is ever missing; False where the system cannot."""
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    if renameat2 is None:
        return False
    return bool(renameat2(AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second), RENAME_EXCHANGE) == 0)


def _move_in_two_steps(folder: Path, place: Path) -> None:
    """The name is missing for a moment: a process that is killed then leaves both folders under temporary names."""
    earlier = _temporary(place, EARLIER)
    place.rename(earlier)
    try:
        folder.rename(place)
    except BaseException:  # Ctrl-C, too
        try:
            earlier.rename(place)
        except OSError as error:
            if error.errno in TAKEN:  # by another process: there is a newer one
                shutil.rmtree(earlier, ignore_errors=True)
        raise
    shutil.rmtree(earlier, ignore_errors=True)
