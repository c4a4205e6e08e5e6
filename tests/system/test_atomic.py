"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from mvseg.errors import InputError
from mvseg.system import atomic
from mvseg.system.atomic import (
    LONG_AGO,
    MACHINE,
    clear_begun,
    folder_whole,
    is_partial,
    lock_folder,
    sweep_abandoned,
    write_text_whole,
    write_whole,
)


def test_a_file_is_replaced_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text_whole(path, "one\n")
    seen = []

    def write(partial: Path) -> None:
        partial.write_text("two")
        seen.extend((path.read_text(), is_partial(partial)))

    write_whole(path, write)
    assert seen == ["one\n", True]
    assert path.read_text() == "two"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text_whole(path, "one")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_whole(path, fail)
    assert path.read_text() == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_replaced_at_the_end(tmp_path: Path) -> None:
    place = tmp_path / "new" / "out"
    with folder_whole(place) as folder:
        (folder / "first").touch()
        assert not place.exists()
        assert is_partial(folder)
    with folder_whole(place) as folder:
        (folder / "second").touch()
        assert (place / "first").exists()
    assert [path.name for path in place.iterdir()] == ["second"]
    assert list(place.parent.iterdir()) == [place]


def test_a_failed_folder_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    place = tmp_path / "out"
    with folder_whole(place) as folder:
        (folder / "first").touch()
    with pytest.raises(KeyboardInterrupt), folder_whole(place) as folder:  # noqa: PT012
        (folder / "second").touch()
        raise KeyboardInterrupt
    assert [path.name for path in place.iterdir()] == ["first"]
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_folder_is_exchanged_at_once_or_in_two_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda first, second: False)
    place = tmp_path / "out"
    for name in ("first", "second"):
        with folder_whole(place) as folder:
            (folder / name).touch()
        assert [path.name for path in place.iterdir()] == [name]
        assert list(tmp_path.iterdir()) == [place]


def test_linux_exchanges(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    (second / "inside").mkdir(parents=True)
    assert atomic._exchange(first, second) == (sys.platform == "linux")
    assert (first / "inside").exists() == (sys.platform == "linux")
    assert not atomic._exchange(first, tmp_path / "absent")


@pytest.mark.parametrize("error", [OSError("no"), KeyboardInterrupt()])
def test_a_folder_that_cannot_be_moved_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    place, rename = tmp_path / "out", Path.rename
    with folder_whole(place) as folder:
        (folder / "first").touch()

    def refuse(path: Path, target: Path) -> Path:
        if target == place and (path / "second").exists():
            raise error
        return rename(path, target)

    monkeypatch.setattr(atomic, "_exchange", lambda first, second: False)
    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(type(error)), folder_whole(place) as folder:
        (folder / "second").touch()
    assert [path.name for path in place.iterdir()] == ["first"]
    assert list(tmp_path.iterdir()) == [place]


def left_behind(name: str, machine: str = MACHINE, kind: str = "") -> str:
    """The temporary name of a write that did not end."""
    return f".{name}.{machine}-{os.urandom(6).hex()}{kind}.partial"


ELSEWHERE = f"{int(MACHINE, 16) ^ 1:08x}"


def age(path: Path, seconds: float) -> None:
    """Make a file, or a folder and all that is in it, so old."""
    for each in (path, *path.rglob("*")):
        os.utime(each, (time.time() - seconds,) * 2)


def test_what_killed_runs_left_is_swept_by_the_next_write_to_that_name(tmp_path: Path) -> None:
    left = [tmp_path / left_behind(name) for name in ("out", "a.txt", "other", "out.txt")]
    for path in left:
        path.mkdir()
        (path / "half").touch()
    with folder_whole(tmp_path / "out"):
        pass
    write_text_whole(tmp_path / "a.txt", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "a.txt", left[2].name, left[3].name}


def test_what_others_are_writing_is_not_swept(tmp_path: Path) -> None:
    kept = [left_behind("out", ELSEWHERE), ".out.partial", ".out.12345678-9-0.partial", "out.txt"]
    for name in kept:
        (tmp_path / name).touch()
    with folder_whole(tmp_path / "out") as folder:
        sweep_abandoned(tmp_path / "out")
        assert folder.is_dir()
        age(folder, 1e6)  # it is locked, however long that takes
        sweep_abandoned(tmp_path / "out")
        assert folder.is_dir()
    assert {path.name for path in tmp_path.iterdir()} == {*kept, "out"}


@pytest.mark.parametrize("why", ["another machine", "no locks"])
def test_without_locks_to_trust_what_is_a_day_old_is_swept(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if why == "no locks":
        monkeypatch.setattr(atomic, "_lock", lambda handle: None)
    left = tmp_path / left_behind("out", MACHINE if why == "no locks" else ELSEWHERE)
    left.mkdir()
    (left / "half").touch()
    age(left, LONG_AGO + 60)
    os.utime(left / "half")  # what is in the folder still grows
    sweep_abandoned(tmp_path / "out")
    assert left.is_dir()
    age(left, LONG_AGO + 60)
    sweep_abandoned(tmp_path / "out")
    assert not left.exists()


WRITER = """
import os, sys
from pathlib import Path
from mvseg.system.atomic import folder_whole

with folder_whole(Path(sys.argv[1])) as folder:
    (folder / "whole").touch()
    print("ready", flush=True)
    sys.stdin.read(1)
"""
SWEEPER = """
import sys
from pathlib import Path
from mvseg.system.atomic import sweep_abandoned

sweep_abandoned(Path(sys.argv[1]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs locks")
@pytest.mark.parametrize("is_killed", [False, True])
@pytest.mark.parametrize("unshare", [(), ("unshare", "--pid", "--fork", "--kill-child")], ids=["plain", "container"])
def test_another_process_keeps_what_it_writes_until_it_dies(
    unshare: tuple[str, ...], is_killed: bool, tmp_path: Path
) -> None:
    """In containers all writers may have the same number, 1, and none is known to the others."""
    if unshare and subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no namespaces of processes here")
    write, sweep = ([*unshare, sys.executable, "-c", code, str(tmp_path / "out")] for code in (WRITER, SWEEPER))
    with subprocess.Popen(write, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        subprocess.run(sweep, check=True)
        (folder,) = tmp_path.iterdir()
        assert [path.name for path in folder.iterdir()] == ["whole"]
        if is_killed:
            writer.kill()
            writer.wait()
            writer.stdout.read()  # until its children are gone, too
            sweep_abandoned(tmp_path / "out")
        else:
            writer.communicate("!")
    assert [path.name for path in tmp_path.iterdir()] == ([] if is_killed else ["out"])


def test_what_is_swept_before_it_is_locked_is_begun_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, lock = [], atomic._lock

    def open_late(path: Path, flags: int) -> int:
        opened.append(path)
        if len(opened) == 1:
            path.rmdir()  # by another process that took it for abandoned
        return os.open(path, flags)

    def lock_late(handle: int) -> bool | None:
        return False if len(opened) == 2 else lock(handle)  # the other process holds it, and is deleting it

    monkeypatch.setattr(atomic, "_lock", lock_late)
    monkeypatch.setattr(atomic, "os", SimpleNamespace(**vars(os) | {"open": open_late}))
    with folder_whole(tmp_path / "out") as folder:
        (folder / "whole").touch()
    assert len({*opened}) == 3
    assert (tmp_path / "out" / "whole").is_file()


def test_a_name_is_no_pattern(tmp_path: Path) -> None:
    (tmp_path / left_behind("a1")).touch()
    sweep_abandoned(tmp_path / "a[1]")
    assert len(list(tmp_path.iterdir())) == 1
    sweep_abandoned(tmp_path / "a1")
    assert not list(tmp_path.iterdir())


def test_links_that_lead_in_a_circle(tmp_path: Path) -> None:
    (tmp_path / "self").symlink_to("self")
    for place in (tmp_path / "self", tmp_path / "self" / "out"):
        with pytest.raises(InputError, match="its links lead in a circle, expected a folder or a new name"):
            folder_whole(place).__enter__()


@pytest.mark.parametrize("machine", [MACHINE, ELSEWHERE])
def test_a_run_killed_between_the_two_steps_of_a_move_has_lost_nothing(machine: str, tmp_path: Path) -> None:
    earlier = tmp_path / left_behind("out", machine, ".earlier")
    earlier.mkdir()
    (earlier / "first").touch()
    sweep_abandoned(tmp_path / "out")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["out", "out/first"]
    earlier.mkdir()
    sweep_abandoned(tmp_path / "out")  # with a result in place, the earlier one is done with
    assert not earlier.exists()
    assert (tmp_path / "out" / "first").exists()


def test_a_full_disk_names_the_path(tmp_path: Path) -> None:
    def fail(partial: Path) -> None:
        raise OSError(28, "No space left on device")  # as `write` does

    path = tmp_path / "a.txt"
    with pytest.raises(OSError, match="No space") as error:
        write_whole(path, fail)
    assert error.value.filename == str(path)
    with pytest.raises(OSError, match="No such file") as error:
        write_text_whole(tmp_path / "absent" / "a.txt", "")
    assert error.value.filename == str(tmp_path / "absent" / "a.txt")  # not the temporary name


@pytest.mark.parametrize("can_exchange", [True, False])
def test_many_moves_to_one_place_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda first, second: False)

    def write(number: int) -> None:
        with folder_whole(tmp_path / "out") as folder:
            for name in ("a", "b"):
                (folder / name).write_text(str(number))

    with ThreadPoolExecutor(16) as pool:
        list(pool.map(write, range(600)))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    texts = [path.read_text() for path in (tmp_path / "out").iterdir()]
    assert len(texts) == 2
    assert len(set(texts)) == 1


def test_a_locked_folder_is_for_one_run_at_a_time(tmp_path: Path) -> None:
    with lock_folder(tmp_path), pytest.raises(InputError, match="another run is writing to this folder"):
        lock_folder(tmp_path).__enter__()
    with lock_folder(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_process_that_was_forked_off_does_not_hold_the_lock(tmp_path: Path) -> None:
    """Data loaders outlive a killed training run by seconds, in which it may be started again."""
    hold, let_go = os.pipe()
    ready, say_ready = os.pipe()
    with lock_folder(tmp_path):
        child = os.fork()
        if not child:
            os.close(let_go)
            os.write(say_ready, b"!")
            os.read(hold, 1)
            os._exit(0)
        os.read(ready, 1)
    try:
        with lock_folder(tmp_path):
            pass
    finally:
        os.close(let_go)
        os.waitpid(child, 0)
        for handle in (hold, ready, say_ready):
            os.close(handle)


@pytest.mark.parametrize("what", ["file", "folder"])
def test_a_signal_while_it_is_cleared_up(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stop(BaseException):
        pass

    def stop(*_: object, **__: object) -> None:
        raise Stop

    def write_half(path: Path) -> None:
        path.write_text("half")
        raise OSError

    def write() -> None:
        if what == "file":
            write_whole(tmp_path / "new.txt", write_half)
        with folder_whole(tmp_path / "new") as folder:
            write_half(folder / "half.txt")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", stop)
        patch.setattr("mvseg.system.atomic.shutil.rmtree", stop)
        with pytest.raises(Stop):
            write()
    (left,) = tmp_path.iterdir()
    assert is_partial(left)
    clear_begun()
    assert [*tmp_path.iterdir()] == []
    clear_begun()  # nothing is left to do
