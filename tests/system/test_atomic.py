"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from mvseg.errors import InputError
from mvseg.system.atomic import (
    LOCK,
    PARTIAL,
    folder_whole,
    is_partial,
    list_files,
    lock_folder,
    sweep_abandoned,
    sweep_folder,
    wait_until_whole,
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


def replace_all(place: Path) -> AbstractContextManager[Path]:
    return folder_whole(place, lambda _: list_files(place))


def test_a_folder_is_replaced_at_the_end(tmp_path: Path) -> None:
    place = tmp_path / "new" / "out"
    with replace_all(place) as folder:
        (folder / "first").touch()
        assert not place.exists()
        assert is_partial(folder)
    with replace_all(place) as folder:
        (folder / "second").touch()
        assert (place / "first").exists()
    assert [path.name for path in place.iterdir()] == ["second"]
    assert list(place.parent.iterdir()) == [place]


def test_a_failed_folder_leaves_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    place = tmp_path / "out"
    with replace_all(place) as folder:
        (folder / "first").touch()
    with pytest.raises(KeyboardInterrupt), replace_all(place) as folder:  # noqa: PT012
        (folder / "second").touch()
        raise KeyboardInterrupt
    assert [path.name for path in place.iterdir()] == ["first"]
    assert list(tmp_path.iterdir()) == [place]


def left_behind(place: Path, kind: str) -> Path:
    """A folder that a killed run has left beside `place`, with a file in it, and its lock."""
    path = place.with_name(f".{place.name}{kind}")
    path.mkdir()
    (path / "half").touch()
    path.with_name(f".{place.name}{LOCK}").touch()
    return path


def test_what_killed_runs_left_is_swept_by_the_next_write_to_that_name(tmp_path: Path) -> None:
    for name in ("out", "a.txt", "other"):
        left_behind(tmp_path / name, PARTIAL)
    with folder_whole(tmp_path / "out"):
        pass
    write_text_whole(tmp_path / "a.txt", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "a.txt", ".other.partial", ".other.lock"}
    sweep_abandoned(tmp_path / "other")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "a.txt"}


def test_a_folder_is_swept_but_for_its_own_lock_and_files_of_others(tmp_path: Path) -> None:
    left_behind(tmp_path / "out", PARTIAL)
    for name in (".hidden", "out.partial"):
        (tmp_path / name).touch()
    with lock_folder(tmp_path):
        sweep_folder(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {".lock", ".hidden", "out.partial"}
    assert {path.name for path in tmp_path.iterdir()} == {".hidden", "out.partial"}


def test_what_is_being_written_is_not_swept(tmp_path: Path) -> None:
    with folder_whole(tmp_path / "out") as folder:
        sweep_abandoned(tmp_path / "out")
        assert folder.is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


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
        assert [path.name for path in (tmp_path / ".out.partial").iterdir()] == ["whole"]
        if is_killed:
            writer.kill()
            writer.wait()
            writer.stdout.read()  # until its children are gone, too
            sweep_abandoned(tmp_path / "out")
        else:
            writer.communicate("!")
    assert [path.name for path in tmp_path.iterdir()] == ([] if is_killed else ["out"])


def test_a_name_that_no_place_has(tmp_path: Path) -> None:
    for path in (tmp_path / "a\0b", tmp_path / "a\0b" / "out"):
        with pytest.raises(InputError, match=r"'.*a\\x00b.*': cannot be the name of a folder"), folder_whole(path):
            pass


def replace_files(place: Path) -> None:
    """`a` stays by name, `old/b` goes, `new/c` is new."""
    with folder_whole(place, lambda _: ["a", "old/b"]) as folder:
        (folder / "new").mkdir()
        (folder / "a").write_text("2")
        (folder / "new" / "c").write_text("2")


CALLS = "replace", "rename", "unlink", "rmdir", "mkdir"


def end_before(number: int) -> None:
    """End the process, as a kill does, before the call of this number that changes a name."""
    counter = iter(range(10_000))

    def count(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if next(counter) == number:
            os._exit(1)
        return original(*args, **kwargs)

    for name in CALLS:
        setattr(os, name, partial(count, getattr(os, name)))


def run_until(number: int, work: Callable[[Path], None], place: Path) -> bool:
    """Whether work in a process of its own was ended before the call of this number."""
    process = os.fork()
    if not process:
        end_before(number)
        work(place)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 1


def times_of(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if not path.name.endswith(LOCK)}


def contents(place: Path) -> dict[str, str]:
    return {path.relative_to(place).as_posix(): path.read_text() for path in place.rglob("*") if path.is_file()}


def kill_everywhere(place: Path) -> None:
    """In a process without torch, which is forked ten times as fast."""
    old, new = {"a": "1", "old/b": "1"}, {"a": "2", "new/c": "2"}
    os.fsync = lambda _: None
    outcomes, step, again = [], 0, 0
    while True:
        (place / "old").mkdir(parents=True, exist_ok=True)
        for name, text in {**old, "mine": "mine"}.items():
            (place / name).write_text(text)
        (place / "empty").mkdir(exist_ok=True)
        is_killed = run_until(step, replace_files, place)
        before = times_of(place.parent)
        with suppress(InputError):
            wait_until_whole(place)
            assert contents(place) in ({**old, "mine": "mine"}, {**new, "mine": "mine"})
        assert before == times_of(place.parent)
        is_killed_again = run_until(again, sweep_abandoned, place)
        sweep_abandoned(place)
        left = contents(place)
        assert left.pop("mine") == "mine"
        assert left in (old, new)
        assert (place / "empty").is_dir()
        assert list(place.parent.iterdir()) == [place]
        shutil.rmtree(place)
        outcomes.append((is_killed, left == new))
        if not is_killed:
            break
        step, again = (step, again + 4) if is_killed_again else (step + 1, 0)
    assert outcomes.count((True, False)) > 20
    assert outcomes.count((True, True)) > 20
    assert outcomes[-1] == (False, True)


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_files_of_a_folder_are_all_old_or_all_new_wherever_a_process_is_killed(tmp_path: Path) -> None:
    """And wherever the process is killed that mends it. A reader before changes nothing, and reads all or nothing."""
    code = "from tests.system.test_atomic import *; kill_everywhere(Path(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], cwd=Path(__file__).parents[2], check=True)


@pytest.mark.parametrize("case", ["mark is a link", "linked folder", "link within", "mark is a file"])
def test_marks_of_a_stranger_move_nothing(tmp_path: Path, case: str) -> None:
    place, mark, other = tmp_path / "out", tmp_path / ".out.mvseg-ready", tmp_path / "other"
    for folder in (place, other):
        folder.mkdir()
        (folder / "keep").write_text("mine")
    if case == "mark is a link":
        mark.symlink_to(other)
    elif case == "mark is a file":
        mark.touch()
    else:
        (mark / "labels").mkdir(parents=True)
        if case == "linked folder":
            (place / "labels").symlink_to(other)
            (mark / "labels" / "keep").write_text("theirs")
        else:
            (mark / "labels" / "link").symlink_to(other / "keep")
    with pytest.raises(InputError, match="no run left"):
        sweep_abandoned(place)
    with pytest.raises(InputError, match="a run was stopped while it replaced these files"):
        wait_until_whole(place)
    assert (other / "keep").read_text() == (place / "keep").read_text() == "mine"


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_a_reader_waits_for_the_writer(tmp_path: Path) -> None:
    place = tmp_path / "out"
    (place / "old").mkdir(parents=True)
    (place / "a").write_text("1")
    ready, say_ready = os.pipe()
    process = os.fork()
    if not process:
        replace = os.replace

        def move(source: Path, target: Path) -> None:
            replace(source, target)
            os.write(say_ready, b"!")
            time.sleep(0.05)

        os.replace = move
        replace_files(place)
        os._exit(0)
    os.read(ready, 1)
    wait_until_whole(place)
    assert contents(place) == {"a": "2", "new/c": "2"}
    os.waitpid(process, 0)
    for handle in (ready, say_ready):
        os.close(handle)


def test_the_root_cannot_be_replaced() -> None:
    with pytest.raises(InputError, match="/: cannot be replaced, expected a folder in it"):
        folder_whole(Path("/")).__enter__()


def test_a_file_that_another_program_has_open_leaves_all_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, replace = tmp_path / "out", os.replace
    (place / "old").mkdir(parents=True)
    (place / "a").write_text("1")
    (place / "old" / "b").write_text("1")

    def refuse(path: Path, target: Path) -> None:
        if path == place / "old" / "b":
            raise PermissionError(13, "Access is denied", str(path), 5, str(target))
        replace(path, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(PermissionError, match="Access is denied"):
        replace_files(place)
    assert contents(place) == {"a": "1", "old/b": "1"}
    assert list(tmp_path.iterdir()) == [place]


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


def test_many_moves_to_one_place_at_once(tmp_path: Path) -> None:
    def write(number: int) -> None:
        with replace_all(tmp_path / "out") as folder:
            for name in ("a", "b"):
                (folder / name).write_text(str(number))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(20)))
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
