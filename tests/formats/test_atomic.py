"""Files and folders appear whole or not at all."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from mvseg.formats import atomic
from mvseg.formats.atomic import folder_whole, is_partial, write_text_whole, write_whole


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
