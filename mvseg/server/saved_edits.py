"""The edits of a page, in memory and in their file, which another program may change."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from mvseg.corrections.file import Corrections, load_corrections, name_edits, parse_corrections, write_corrections
from mvseg.errors import InputError

CORRECTIONS_FILE = "corrections.json"
CHANGED = "corrections.json was changed by another program since this page was loaded."
Read = Callable[[], tuple[Corrections, str]]  # the edits in the folder, and what the user should know of them


@dataclass(frozen=True)
class Update:
    """Consequences of edits: the news for the page, the problem of each edit ("" for none), and warnings."""

    news: dict[str, Any] | None
    outcomes: list[str]
    messages: list[str]


class Refused(Exception):
    """A request that is not answered, with the status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


def read_saved(folder: Path) -> Corrections:
    """The edits saved in a folder; none where there is no file."""
    path = folder / CORRECTIONS_FILE
    return load_corrections(path) if path.is_file() else Corrections()


class SavedEdits:
    """The newest edits of a folder. Not safe for threads: the owner locks. `notice` is for the user, or ""."""

    def __init__(self, folder: Path, read: Read) -> None:
        """Raises InputError: the edits in the folder cannot be read, or are another scene's."""
        self.path = folder / CORRECTIONS_FILE
        self._stamp = self._find_stamp()
        self.corrections, self.notice = read()
        self._own: set[str] = set()  # `name_edits` of the lists written since `begin`

    @property
    def name(self) -> str:
        return name_edits(self.corrections.edits)

    def save(self, text: bytes, base: str, mark: Callable[[Corrections], Corrections]) -> None:
        """Write the edits of a corrections.json. `base` is the `name_edits` of the list that this one was made from;
        `mark` adds marks to the edits before they are written.

        Raises InputError: this is no list of edits; Refused: it was made from another list than the one that is saved,
        and would undo edits of another page; OSError: the file cannot be written; the edits stay as they were.
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            raise InputError("the edits are not whole JSON") from None
        corrections = parse_corrections(content)
        if self.name not in (base, name_edits(corrections.edits)):  # the same again: its answer was lost
            raise Refused(HTTPStatus.CONFLICT, "Another page has changed the edits since this one was loaded.")
        if self.is_changed():
            raise Refused(HTTPStatus.CONFLICT, CHANGED)
        self.write(mark(corrections))

    def is_changed(self) -> bool:
        """Whether another program has written other edits to the file. (One that was deleted is written again.)"""
        stamp = self._find_stamp()
        if stamp in (None, self._stamp):
            return False
        with suppress(InputError):  # broken, and so changed
            if name_edits(read_saved(self.path.parent).edits) == self.name:
                self._stamp = stamp
        return self._stamp != stamp

    def take_changes(self, read: Read) -> bool:
        """Go on from the file if another program has written to it; False where it has written nothing. Raises
        InputError: it cannot be read; the edits stay as they were."""
        if not self.is_changed():
            return False
        stamp = self._find_stamp()
        self.corrections, self.notice = read()
        self._stamp = stamp
        return True

    def write(self, corrections: Corrections) -> None:
        write_corrections(self.path, corrections)
        self.corrections, self._stamp = corrections, self._find_stamp()
        self._own.add(self.name)

    def begin(self) -> None:
        """Write the newest edits before the folder is made anew. Raises InputError: another program changed it."""
        if self.is_changed():
            raise InputError(CHANGED)
        self._own.clear()
        self.write(self.corrections)

    def write_again(self) -> None:
        """Write the newest edits after the folder was made anew, where the file holds earlier ones of this page,
        whoever put them back; but never over those of another program."""
        with suppress(InputError):  # theirs, and broken: `is_changed` says so
            if name_edits(read_saved(self.path.parent).edits) in self._own:
                self.write(self.corrections)

    def _find_stamp(self) -> tuple[int, int] | None:
        with suppress(OSError):
            about = self.path.stat()
            return about.st_mtime_ns, about.st_size
        return None
