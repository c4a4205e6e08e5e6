"""Replace on finish: a file or folder appears complete under its name, or not at all.

What is being written has a temporary name beside its place, `.<name>.<machine>-<process>-<number>.partial`. A process
that is killed leaves that behind, and never a part under the final name; the next write to the same name deletes it.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import platform
import re
import shutil
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mvseg.errors import InputError

if sys.platform != "win32":
    import fcntl

SUFFIX, EARLIER = ".partial", ".earlier"
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux; paths are absolute or start where the process runs
MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"  # disks are shared: the number of a process is not enough
WRITER = re.compile(rf"\.([0-9a-f]{{8}})-(\d{{1,10}})-\d+(?:\{EARLIER})?\{SUFFIX}$")
TAKEN = (errno.ENOTEMPTY, errno.EEXIST)
MOVES = 10_000  # attempts, before a place that other processes keep taking is given up

_numbers = itertools.count()
_in_use: set[str] = set()  # temporary names of this process
_begun: set[Path] = set()  # temporary files and folders of this process that may still be there
_locked: set[int] = set()  # handles of folders that this process has locked


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
        if partial.is_dir() and not partial.is_symlink():
            shutil.rmtree(partial, ignore_errors=True)
        else:
            partial.unlink(missing_ok=True)
    _begun.clear()


def is_partial(path: Path) -> bool:
    """Whether a path is what a write has not finished, or never will."""
    return path.name.startswith(".") and path.name.endswith(SUFFIX)


def is_abandoned(path: Path) -> bool:
    """Whether a path is what a killed process of this machine left behind.

    What a process of another machine is writing to a shared disk never is.
    """
    writer = WRITER.search(path.name)
    if not path.name.startswith(".") or writer is None or writer[1] != MACHINE or path.name in _in_use:
        return False
    process = int(writer[2])
    if process == os.getpid():
        return True
    if sys.platform == "win32":  # which has no harmless signal
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # somebody else's process
        return False
    return False


def sweep_abandoned(place: Path) -> None:
    """Delete what killed runs left beside `place` while they were writing it.

    One that was killed between the two steps of a move (where the system cannot exchange folders) left nothing at
    `place`: then its earlier folder comes back.
    """
    place = place.resolve()
    left = [path for path in place.parent.glob(f".{_escape(place.name)}.*{SUFFIX}") if is_abandoned(path)]
    for path in left:
        if path.name.endswith(EARLIER + SUFFIX) and not os.path.lexists(place):
            with suppress(OSError):  # another process was quicker
                path.rename(place)
        elif path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


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
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BaseException as error:
        os.close(handle)
        if not isinstance(error, OSError):  # a signal, while it waits
            raise
        if error.errno not in (errno.EAGAIN, errno.EACCES):  # a disk without locks
            yield
            return
        raise InputError(f"{folder}: another run is writing to this folder, expected one at a time") from None
    _locked.add(handle)
    try:
        yield
    finally:
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
    with _beside(path) as partial:
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

    A folder that is at `place` stays until the new one is complete, and is deleted then. Any number of processes may
    do so at once: the last one to finish wins.

    Raises:
        OSError: the folder cannot be made or moved.
    """
    place = place.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    sweep_abandoned(place)
    with _beside(place) as partial:
        partial.mkdir()
        try:
            yield partial
            _move(partial, place)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _beside(path: Path, kind: str = "") -> Iterator[Path]:
    """A temporary name that nobody else uses."""
    partial = path.with_name(f".{path.name}.{MACHINE}-{os.getpid()}-{next(_numbers)}{kind}{SUFFIX}")
    _in_use.add(partial.name)
    if not kind:  # an earlier result is not to be deleted
        _begun.add(partial)
    try:
        yield partial
    finally:
        _in_use.discard(partial.name)
        if not os.path.lexists(partial):
            _begun.discard(partial)


def _escape(name: str) -> str:
    """A name as a pattern that only fits itself."""
    return re.sub(r"([*?[])", r"[\1]", name)


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
    with _beside(place, EARLIER) as earlier:
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
