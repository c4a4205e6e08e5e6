"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mvseg.errors import InputError
from mvseg.system import atomic
from mvseg.system.atomic import (
    MACHINE,
    clear_begun,
    folder_whole,
    is_abandoned,
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


@pytest.fixture(scope="module")
def dead() -> int:
    """The number of a process that is no more."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def test_what_killed_runs_left_is_swept_by_the_next_write_to_that_name(tmp_path: Path, dead: int) -> None:
    left = [tmp_path / f".{name}.{MACHINE}-{dead}-0.partial" for name in ("out", "a.txt", "other")]
    for path in left:
        path.mkdir()
        (path / "half").touch()
    with folder_whole(tmp_path / "out"):
        pass
    write_text_whole(tmp_path / "a.txt", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "a.txt", left[2].name}


def test_what_others_are_writing_is_not_swept(tmp_path: Path, dead: int) -> None:
    elsewhere = f"{int(MACHINE, 16) ^ 1:08x}"
    kept = [f".out.{elsewhere}-{dead}-0.partial", f".out.{MACHINE}-{os.getppid()}-0.partial", ".out.partial", "out.txt"]
    for name in kept:
        (tmp_path / name).touch()
    with folder_whole(tmp_path / "out") as folder:
        assert not is_abandoned(folder)
        sweep_abandoned(tmp_path / "out")
        assert folder.is_dir()
    assert {path.name for path in tmp_path.iterdir()} == {*kept, "out"}


def test_a_name_is_no_pattern(tmp_path: Path, dead: int) -> None:
    (tmp_path / f".a1.{MACHINE}-{dead}-0.partial").touch()
    sweep_abandoned(tmp_path / "a[1]")
    assert len(list(tmp_path.iterdir())) == 1
    sweep_abandoned(tmp_path / "a1")
    assert not list(tmp_path.iterdir())


def test_a_run_killed_between_the_two_steps_of_a_move_has_lost_nothing(tmp_path: Path, dead: int) -> None:
    earlier = tmp_path / f".out.{MACHINE}-{dead}-1.earlier.partial"
    earlier.mkdir()
    (earlier / "first").touch()
    sweep_abandoned(tmp_path / "out")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["out", "out/first"]
    earlier.mkdir()
    sweep_abandoned(tmp_path / "out")  # with a result in place, the earlier one is done with
    assert not earlier.exists()
    assert (tmp_path / "out" / "first").exists()


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
