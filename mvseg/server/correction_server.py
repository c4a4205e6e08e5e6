"""What a person corrects in a page: each edit is saved at once, and its consequences are computed and shown."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Generic, Protocol, TypeVar

from mvseg.corrections.file import Corrections, load_corrections, name_edits, parse_corrections, write_corrections
from mvseg.errors import InputError
from mvseg.system.running import Cancelled, running

CORRECTIONS_FILE = "corrections.json"
WAIT_SECONDS = 20.0  # that a page's question for news stays open
LOOK_SECONDS = 1.0  # until it looks again whether another program has changed the edits
STEP_SECONDS = 1.0  # between two words of what is computed
LEARN_SECONDS, LEARN_SECONDS_PER_PHOTO = 90, 6  # that learning takes on two cores, which the page says before
CHANGED = "corrections.json was changed by another program since this page was loaded."


def run_command(words: Sequence[str], tell: Callable[[str], None]) -> tuple[int, str]:
    """Run `mvseg` in a process of its own: its exit code, and the last line that it told."""
    command, said = [sys.executable, "-m", "mvseg.cli", *words], ""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr or ():
            if line.strip():
                said = line.strip()
                tell(said)
    return process.returncode, said


class Refused(Exception):
    """A request that is not answered, with the status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Opened(Protocol):
    """A folder that a person corrects: a result, or tracks.

    Attributes:
        folder: holds `CORRECTIONS_FILE`.
        learner: of a result that a detector found.
        answers: {place: what else the page asks there}, by the body of a request.
    """

    folder: Path

    @property
    def answers(self) -> Mapping[str, Callable[[bytes], Mapping[str, Any]]]: ...

    @property
    def learner(self) -> Learner | None: ...

    def read_edits(self) -> tuple[Corrections, str]:
        """The edits in the folder, and what a person should know of them. Raises InputError: they cannot be read."""

    def mark(self, corrections: Corrections) -> Corrections:
        """The edits as they are saved."""

    def page(self, corrections: Corrections) -> str:
        """The page with the newest result, and with all edits."""

    def updates(self, corrections: Corrections, is_old: Callable[[], bool]) -> Iterator[Update]:
        """What follows from the edits, perhaps in several steps. Raises Cancelled: `is_old` said so; InputError."""

    def again(self, place: Path) -> list[str]:
        """The words after `mvseg` that make all in the folder anew; they may name files written into `place`."""

    def reopened(self) -> Any:
        """The folder as it is now. Raises InputError."""


class Learner(Protocol):
    """A detector that may learn from `num_views` photos, see `OpenResult.learn`; `is_learned`: it has."""

    @property
    def is_learned(self) -> bool: ...

    @property
    def num_views(self) -> int: ...

    def learn(self, corrections: Corrections, is_old: Callable[[], bool], report: Callable[[str], None]) -> None: ...

    def unlearn(self) -> None: ...


@dataclass(frozen=True)
class Update:
    """What follows from edits: the news for the page, what hinders each edit ("" for nothing), and warnings."""

    news: dict[str, Any] | None
    outcomes: list[str]
    messages: list[str]


Kind = TypeVar("Kind", bound=Opened)


class Corrector(Generic[Kind]):
    """What is open, its newest edits, and a thread that computes their consequences; the newest edits win.

    The same thread lets the detector learn: what is edited meanwhile is saved, and computed afterwards.
    """

    def __init__(self, opened: Kind) -> None:
        """Raises InputError: the corrections saved in the folder cannot be read, or are another scene's."""
        self.opened = opened
        self.written = self._stamp()
        self.corrections, self.notice = opened.read_edits()
        self.news = threading.Condition()
        self.wanted, self.computed = 1, 0
        self.number, self.updated = 0, 0  # of all news, and of the newest result among them
        self.learning, self.is_cancelled = "", False  # what is done of it, "" for nothing
        self.doing, self.said_at = "", 0.0  # what is computed, "" for nothing, and when that was said last
        self.problem, self.outcomes = self.notice, [""] * len(self.corrections.edits)
        self.update: dict[str, Any] | None = None
        self.is_closing = False
        self.making_whole, self.making = threading.Lock(), ""  # what is done of it, "" for nothing
        self.own: set[str] = set()  # `name_edits` of the lists written since the whole result was begun

    def page(self) -> bytes:
        """The page with the newest result, and with all edits that were saved: a reload must not lose any; nor those
        that another program has written to the file since."""
        with self.news:
            self._take_changes()
            corrections = self.corrections
        return self.opened.page(corrections).encode()

    def save(self, text: bytes, base: str) -> dict[str, Any]:
        """Write the edits of a corrections.json to the result folder and have them computed; returns their number and
        `name_edits`. `base`: the `name_edits` of the list that this one was made from.

        Raises:
            InputError: this is no list of edits.
            Refused: it was made from another list than the one that is saved: it would undo edits of another page.
            OSError: the file cannot be written.
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            raise InputError("the edits are not whole JSON") from None
        corrections = parse_corrections(content)
        name = name_edits(corrections.edits)
        with self.news:  # one after another, in the order in which they are wanted
            if name_edits(self.corrections.edits) not in (base, name):  # the same again: its answer was lost
                raise Refused(HTTPStatus.CONFLICT, "Another page has changed the edits since this one was loaded.")
            if self._is_changed():
                raise Refused(HTTPStatus.CONFLICT, CHANGED)
            before, self.corrections = self.corrections, self.opened.mark(corrections)
            try:
                self._write()
            except OSError:
                self.corrections = before
                raise
            self.wanted += 1
            self.news.notify_all()
        return {"saved": len(self.corrections.edits), "revision": name}

    def _stamp(self) -> tuple[int, int] | None:
        """What changes when the file of the edits does; None without one."""
        try:
            about = (self.opened.folder / CORRECTIONS_FILE).stat()
        except OSError:
            return None
        return about.st_mtime_ns, about.st_size

    def _saved(self) -> Corrections:
        path = self.opened.folder / CORRECTIONS_FILE
        return load_corrections(path) if path.is_file() else Corrections()

    def _is_changed(self) -> bool:
        """Whether another program has written other edits to the file. (One that was deleted is written again.)"""
        stamp = self._stamp()
        if stamp in (None, self.written):
            return False
        try:
            found = self._saved()
        except InputError:
            return True
        if name_edits(found.edits) != name_edits(self.corrections.edits):
            return True
        self.written = stamp
        return False

    def _take_changes(self) -> None:
        """Go on from what another program has written to the file, if it can be read."""
        if not self._is_changed():
            return
        try:
            stamp = self._stamp()
            self.corrections, self.notice = self.opened.read_edits()
        except InputError as error:
            self.problem = f"{error}. The edits on this page are those before."
            return
        self.written = stamp
        self.wanted += 1
        self.news.notify_all()

    def compute(self) -> None:
        """Work until `close`; for a thread of its own."""
        while True:
            with self.news:
                self.news.wait_for(lambda: self.is_closing or self.learning or self.wanted > self.computed)
                if self.is_closing:
                    return
                wanted, corrections, is_learning = self.wanted, self.corrections, bool(self.learning)
            if is_learning:
                self._learn_once(corrections)
            else:
                self._compute_once(wanted, corrections)

    def _learn_once(self, corrections: Corrections) -> None:
        problem, wanted = self.problem, 0
        try:
            self._learner().learn(corrections, lambda: self.is_closing or self.is_cancelled, self._tell)
            wanted = 1  # all follows anew
        except Cancelled:
            pass
        except InputError as error:
            problem = str(error)
        except Exception as error:  # nor over this
            problem = f"Nothing was learned ({type(error).__name__}: {error})."
        with self.news:
            self.wanted += wanted
            self.learning, self.problem = "", problem
            self._notify()

    def _tell_step(self, said: str) -> None:
        """What is computed, for the page, from time to time."""
        if (now := time.monotonic()) - self.said_at >= STEP_SECONDS:
            with self.news:
                self.doing, self.said_at = said, now
                self._notify()

    def _tell(self, said: str) -> None:
        with self.news:
            self.learning = said
            self._notify()

    def _notify(self) -> None:
        """There is something new to hear of, for whoever holds the lock."""
        self.number += 1
        self.news.notify_all()

    def _compute_once(self, wanted: int, corrections: Corrections) -> None:
        def is_old() -> bool:
            return self.is_closing or bool(self.learning) or self.wanted > wanted

        self.said_at = time.monotonic()  # what is done at once, needs no words
        try:
            with running(report=self._tell_step):
                for update in self.opened.updates(corrections, is_old):
                    self._publish(update, " ".join([self.notice, *update.messages]).strip(), wanted)
            return
        except Cancelled:
            return
        except InputError as error:
            problem = str(error)
        except Exception as error:  # the person must not lose the page over what one list of edits does
            problem = f"This could not be computed ({type(error).__name__}: {error}); your edits are saved."
        self._publish(Update(self.update, [""] * len(corrections.edits), []), problem, wanted)

    def _publish(self, update: Update, problem: str, wanted: int) -> None:
        with self.news:
            self.update, self.outcomes = update.news, update.outcomes
            self.problem, self.computed, self.doing = problem, wanted, ""
            self._notify()
            self.updated = self.number

    def state(self, after: int) -> dict[str, Any]:
        """What the page shows, and the name of the edits that are saved (`revision`): at once for an `after` below 0,
        otherwise as soon as there is something newer."""
        with self.news:
            end = time.monotonic() + WAIT_SECONDS
            while 0 <= after >= self.number and not self.is_closing and time.monotonic() < end:
                if self._is_changed():
                    break
                self.news.wait(LOOK_SECONDS)
            return {
                "number": self.number,
                "revision": name_edits(self.corrections.edits),
                "isComputing": self.wanted > self.computed,
                "doing": self.doing,
                "isChanged": self._is_changed(),
                "problem": self.problem,
                "outcomes": self.outcomes,
                "update": self.update if self.updated > after else None,
                "learning": self._describe_learning(),
                "making": self.making,
            }

    def _describe_learning(self) -> dict[str, Any] | None:
        if (learner := self.opened.learner) is None:
            return None
        seconds = LEARN_SECONDS + LEARN_SECONDS_PER_PHOTO * learner.num_views
        return {"now": self.learning, "isLearned": learner.is_learned, "seconds": seconds}

    def _learner(self) -> Learner:
        if (learner := self.opened.learner) is None:
            raise Refused(HTTPStatus.CONFLICT, "No detector found these masks, so there is none that could learn.")
        return learner

    def learn(self) -> dict[str, Any]:
        """Let the detector learn the leaves that the views agree about, and those that a person outlined, see
        `OpenResult.learn`; `state` says how far it is.

        Raises:
            Refused: there is no detector; it learns already, or the whole result is being made.
        """
        with self.news:
            self._learner()
            self._refuse_while_learning()
            if self.making_whole.locked():
                raise Refused(HTTPStatus.CONFLICT, "The whole result is being made: wait until it is there.")
            self.learning, self.is_cancelled = "looking for what to learn from", False
            self._notify()
        return {}

    def cancel(self) -> dict[str, Any]:
        """Learn no further; all stays as it was."""
        with self.news:
            self.is_cancelled = True
        return {}

    def unlearn(self) -> dict[str, Any]:
        """Go back to the detector before it learned.

        Raises:
            Refused: there is no detector; it learns.
        """
        with self.news:
            self._refuse_while_learning()
            if (learner := self._learner()).is_learned:
                learner.unlearn()
                self.wanted += 1
                self._notify()
        return {}

    def _refuse_while_learning(self) -> None:
        if self.learning:
            raise Refused(HTTPStatus.CONFLICT, "The detector is learning: wait until it is done, or cancel it.")

    def whole(self) -> dict[str, Any]:
        """Make the whole result with the saved edits, and with what was learned, in its place, by a process of its own;
        `state` says how far it is. Then the page is that of the new result.

        Raises:
            Refused: it is being made already, or the detector learns.
            InputError: the run ended with an error; its sentence.
        """
        if not self.making_whole.acquire(blocking=False):
            raise Refused(HTTPStatus.CONFLICT, "The whole result is being made already.")
        try:
            folder = self.opened.folder.resolve()
            path = folder / CORRECTIONS_FILE
            with self.news:
                self._refuse_while_learning()
                if self._is_changed():
                    raise InputError(CHANGED)
                self._write()
                self.own = {name_edits(self.corrections.edits)}
            with TemporaryDirectory() as place:
                words = [*self.opened.again(Path(place)), "--corrections", str(path)]
                returncode, said = run_command(words, self._tell_making)
            with self.news:
                self._write_newest()
            if returncode:
                raise InputError(said or "the run was stopped")
            opened = self.opened.reopened()
            with self.news:
                self.opened, self.update = opened, None
                self.wanted += 1
        finally:
            self._tell_making("")
            self.making_whole.release()
        return {}

    def _tell_making(self, said: str) -> None:
        with self.news:
            self.making = said
            self._notify()

    def _write(self) -> None:
        write_corrections(self.opened.folder / CORRECTIONS_FILE, self.corrections)
        self.written = self._stamp()
        self.own.add(name_edits(self.corrections.edits))

    def _write_newest(self) -> None:
        """After the folder was made anew: write the newest edits again where the file holds earlier ones of this page,
        whoever put them back; but never over those of another program."""
        with suppress(InputError):  # theirs, and broken: `_is_changed` says so
            if name_edits(self._saved().edits) in self.own:
                self._write()

    def close(self) -> None:
        """Let everybody who waits go."""
        with self.news:
            self.is_closing = True
            self.news.notify_all()
