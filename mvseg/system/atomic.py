"""Replace on finish: a file or folder appears complete under its name, or not at all.

What is being written to NAME is called `.NAME.partial` until it is complete, and `.NAME.lock` is locked meanwhile. Then
all files in NAME that go, or whose names the new ones have, move to `.NAME.mvseg-aside`; `.NAME.partial` becomes
`.NAME.mvseg-ready`, from which moment on the new files win; its files move to NAME; what was put aside is deleted, and
`.NAME.mvseg-ready` last. Everything else in NAME stays. Locks end with their process: what a killed process left is put
back (no `.mvseg-ready` yet) or completed by the next write to NAME. Whoever only reads NAME waits for the writer, and
completes nothing: a folder from a stranger may have such names beside it. On a disk without locks, two processes must
not write to one NAME at the same time.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile, mkstemp
from typing import Any

from filelock import FileLock, Timeout

from mvseg.errors import InputError

PARTIAL, ASIDE, READY, LOCK = ".partial", ".mvseg-aside", ".mvseg-ready", ".lock"
LEFT = (PARTIAL, ASIDE, READY, LOCK)  # what killed runs leave
OTHER_RUN = "another run is writing to this folder"
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)  # errors of disks without locks


def resolve_place(place: Path) -> Path:
    """The absolute path of a place that need not exist, without links. Raises InputError if its links form a loop, or
    its name cannot be one."""
    try:
        place.stat()
    except ValueError:  # a null character
        raise InputError(f"{str(place)!r}: cannot be the name of a folder") from None
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(f"{place}: its links form a loop, expected a folder or a new name") from None
    return place.resolve()


def try_writing(folder: Path) -> None:
    """Make a nameless file in a folder: read-only disks and /proc look writable to whoever may do everything, and a
    lock there would be waited for without end. Raises OSError if nothing can be written there."""
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None


def try_moving(place: Path) -> None:
    """Move a file into a folder from beside it, as `folder_whole` will, and delete it. Raises OSError if it cannot be
    moved there; EXDEV: the folder is a disk of its own."""
    handle, name = mkstemp(PARTIAL, ".", place.parent)
    os.close(handle)
    try:
        os.replace(name, place / Path(name).name)
        name = str(place / Path(name).name)
    finally:
        os.unlink(name)


def is_partial(path: Path) -> bool:
    """Whether a path is an unfinished or abandoned write, or its lock."""
    return path.name.startswith(".") and path.name.endswith(LEFT)


def sweep_abandoned(place: Path) -> None:
    """Complete, undo or delete what killed runs left beside `place`, unless another run is writing it now. For whoever
    is about to write there; see `wait_until_whole`. Raises InputError as `resolve_place`, or if no run left it."""
    place = resolve_place(place)
    if not any(os.path.lexists(_beside(place, kind)) for kind in LEFT):
        return
    with ExitStack() as stack:
        try:
            stack.enter_context(_locked(_beside(place, LOCK)))
        except (InputError, OSError):  # another run's, or another user's
            return
        with suppress(OSError):
            _settle(place)


def wait_until_whole(place: Path) -> None:
    """Wait while another run replaces the files of a folder that is to be read; nothing is changed. Raises InputError
    as `resolve_place`, or if a run was killed while it replaced them."""
    place = resolve_place(place)
    marks = [_beside(place, kind) for kind in (ASIDE, READY)]
    if not any(map(os.path.lexists, marks)):
        return
    with suppress(OSError), _locked(_beside(place, LOCK), wait=True):
        pass
    if any(map(os.path.lexists, marks)):
        message = "a run was stopped while it replaced these files, expected the same run once more, which completes it"
        raise InputError(f"{place}: {message}")


def sweep_folder(folder: Path) -> None:
    """`sweep_abandoned` for everything in a folder."""
    names = {path.name for path in folder.iterdir() if is_partial(path)} - set(LEFT)
    for name in {name[1:].rpartition(".")[0] for name in names}:
        sweep_abandoned(folder / name)


def lock_folder(folder: Path, *, wait: bool = False, other: str = OTHER_RUN) -> AbstractContextManager[None]:
    """Keep other runs out of a folder in which files are added one by one; the lock ends with the process. Raises
    InputError if another process works in it, and `wait` is not set; `other` says what that does."""
    return _locked(folder / LOCK, wait=wait, other=other)


@contextmanager
def _locked(path: Path, *, wait: bool = False, other: str = OTHER_RUN) -> Iterator[None]:
    """Lock a file that exists only while a process holds the lock, or after its holder was killed."""
    if not path.parent.is_dir():  # filelock would make it
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    if wait:
        try_writing(path.parent)
    lock = FileLock(path, timeout=-1 if wait else 0, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"{path.parent}: {other}, expected one at a time") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        yield
    finally:
        with suppress(OSError):  # on Windows, where filelock deletes it
            path.unlink()  # before the release: a waiting process notices, and makes a new one
        lock.release()


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` make a file under a temporary name, then move it to `path`, in a folder that exists. A reader, or a
    run that was killed at any moment, finds the old content or the new one. Raises OSError if the file cannot be
    written; nothing is left behind."""
    with _writing(path) as partial:
        partial.touch(exist_ok=False)
        write(partial)
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)


def write_text_whole(path: Path, text: str) -> None:
    """Write UTF-8 text with "\\n" at the ends of lines on every system; see `write_whole`."""
    write_whole(path, lambda partial: partial.write_text(text, encoding="utf-8", newline="\n"))


@contextmanager
def folder_whole(place: Path, replaced: Callable[[Path], Collection[str]] = lambda _: ()) -> Iterator[Path]:
    """Make a new folder to write into, whose files take the places of earlier ones in `place`, which may be new, when
    the block ends. Of several processes, each waits for the one before it.

    Args:
        replaced: called with the new folder at the end; returns the names of the files in `place` that go. Everything
            else stays where it is: nobody needs to know what it is, nor to stop writing it.

    Raises:
        InputError: see `resolve_place`.
        OSError: the folder cannot be made, or an earlier file cannot be moved; then all of them are as they were.
    """
    place = resolve_place(place)
    place.parent.mkdir(parents=True, exist_ok=True)
    with _writing(place) as partial:
        partial.mkdir()
        yield partial
        _sync_files(partial)
        names = {*replaced(partial), *list_files(partial)}
        _move_files(sorted(each for each in names if os.path.lexists(place / each)), place, _beside(place, ASIDE))
        os.replace(partial, _beside(place, READY))  # from here on the new files win, see `_settle`
        _sync_folder(place.parent)


def list_files(folder: Path) -> list[str]:
    """The names of all files and links below a folder, with "/"."""
    files = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in files)


def _move_files(names: Collection[str], source: Path, target: Path) -> None:
    """Move files to the same places in another folder, where none may be, and delete folders that become empty."""
    for name in names:
        links = [target / each for each in Path(name).parents if (target / each).is_symlink()]
        if links or os.path.lexists(target / name):
            raise InputError(f"{source / name}: no run left it there, since {(links or [target / name])[0]} exists")
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / name, target / name)
    folders = {folder for name in names for folder in Path(name).parents}
    for folder in folders:
        _sync_folder(target / folder)
    for folder in sorted(folders - {Path()}, key=lambda each: -len(each.parts)):
        with suppress(OSError):  # it holds other files, or is gone
            (source / folder).rmdir()


def _sync_files(folder: Path) -> None:
    for path in (*folder.rglob("*"), folder):
        if path.is_dir():
            _sync_folder(path)
        else:
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def _writing(place: Path) -> Iterator[Path]:
    """A temporary name beside a place, deleted at the end, for this process alone; an OSError names `place`."""
    try:
        with _locked(_beside(place, LOCK), wait=True):
            try:
                _settle(place)
                yield _beside(place, PARTIAL)
            finally:
                _settle(place)
    except OSError as error:
        if error.errno is not None and (error.filename is None or is_partial(Path(str(error.filename)))):
            error.filename = str(place)
        raise


def _beside(place: Path, kind: str) -> Path:
    if not place.name:
        raise InputError(f"{place}: cannot be replaced, expected a folder in it")
    return place.with_name(f".{place.name}{kind}")


def _settle(place: Path) -> None:
    """Complete, undo or delete the remains of an earlier write, under the lock; they always say which files win."""
    partial, aside, ready = (_beside(place, kind) for kind in (PARTIAL, ASIDE, READY))
    for mark in (aside, ready):
        if mark.is_symlink() or (mark.exists() and not mark.is_dir()):
            raise InputError(f"{mark}: is a file or a link, which no run left there; expected to find it deleted")
    if ready.is_dir():
        if linked := [name for name in list_files(ready) if (ready / name).is_symlink()]:
            raise InputError(f"{ready / linked[0]}: is a link, which no run left there; expected to find it deleted")
        if os.path.lexists(place):
            _move_files(list_files(ready), ready, place)
            _delete(aside)
            _delete(ready)
        else:
            _delete(aside)
            os.replace(ready, place)
    elif aside.is_dir():
        if os.path.lexists(place):
            _move_files(list_files(aside), aside, place)
            _delete(aside)
        else:
            os.replace(aside, place)
    _delete(partial)


def _delete(path: Path) -> None:
    if not os.path.lexists(path):
        return
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    _sync_folder(path.parent)
