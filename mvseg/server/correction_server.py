"""Corrections of the user in a page: each edit is saved at once, and its consequences are computed and shown."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from http import HTTPStatus
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mvseg._version import PACKAGE
from mvseg.corrections.file import Corrections
from mvseg.errors import InputError
from mvseg.server.saved_edits import Refused, SavedEdits, Update
from mvseg.system.running import Cancelled, running

if TYPE_CHECKING:
    from mvseg.server.open_result import OpenResult
    from mvseg.server.open_tracks import OpenTracks

WAIT_SECONDS = 20.0  # limit: that a page's question for news stays open
LOOK_SECONDS = 1.0  # limit: until it looks again whether another program has changed the edits
STEP_SECONDS = 1.0  # limit: between two words about a computation
LEARN_SECONDS, LEARN_SECONDS_PER_PHOTO = 90, 6  # chosen: that learning takes on two cores, which the page says before


def run_command(words: Sequence[str], tell: Callable[[str], None]) -> tuple[int, str]:
    """Run `mvseg` in a process of its own: its exit code, and the last line on its stderr."""
    command, last_line = [sys.executable, "-P", "-m", "mvseg.cli", *words], ""  # -P: nothing of the user's folder
    place = os.pathsep.join(filter(None, (str(PACKAGE.parent), os.environ.get("PYTHONPATH"))))
    env = os.environ | {"PYTHONPATH": place}
    with subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr or ():
            if line.strip():
                last_line = line.strip()
                tell(last_line)
    return process.returncode, last_line


@dataclass(frozen=True)
class Idle:
    """All that follows from the edits is computed."""


@dataclass(frozen=True)
class Computing:
    """The consequences of the newest edits are computed; `doing` names a long step, "" for a short one."""

    number: int
    doing: str = ""


@dataclass(frozen=True)
class Learning:
    """The detector learns; `doing` says how far it is, and `then` is what comes back where it learns nothing."""

    doing: str
    then: Idle | Computing
    is_cancelled: bool = False


@dataclass(frozen=True)
class Closed:
    """Nobody waits any more."""


Task = Idle | Computing | Learning | Closed


@dataclass(frozen=True)
class PageState:
    """The newest result on the page, a sentence about its `problem` ("" for none), and the number of its news."""

    update: Update
    problem: str = ""
    number: int = 0


class Corrector:
    """An open folder, its newest edits, and a thread that computes their consequences; the newest edits win.

    The same thread lets the detector learn: what is edited meanwhile is saved, and computed afterwards. `news` is the
    lock of all attributes, and wakes who waits; `number` counts all news. `making` says how far the whole result is,
    which another thread makes; None: it is not made.
    """

    def __init__(self, opened: OpenResult | OpenTracks) -> None:
        """Raises InputError: the corrections saved in the folder cannot be read, or are another scene's."""
        self.opened, self.news, self.number = opened, threading.Condition(), 0
        self.edits = SavedEdits(opened.folder, opened.read_edits)
        self.page_state = PageState(Update(None, [""] * len(self.edits.corrections.edits), []), self.edits.notice)
        self._numbers = itertools.count()  # of lists of edits
        self.task: Task = Computing(next(self._numbers))
        self.making: str | None = None

    def page(self) -> bytes:
        """The page with the newest result, and all saved edits, also those of another program."""
        with self.news:
            try:
                if self.edits.take_changes(self.opened.read_edits):
                    self._compute_anew()
            except InputError as error:
                self.page_state = replace(self.page_state, problem=f"{error}. The edits on this page are those before.")
            corrections = self.edits.corrections
        return self.opened.page(corrections).encode()

    def save(self, text: bytes, base: str) -> dict[str, Any]:
        """Write the edits of a corrections.json to the folder, see `SavedEdits.save`, and have their consequences
        computed; returns their number and `name_edits`."""
        with self.news:  # one after another, in the order in which they are wanted
            self.edits.save(text, base, self.opened.mark)
            self._compute_anew()
            return {"saved": len(self.edits.corrections.edits), "revision": self.edits.name}

    def compute(self) -> None:
        """Work until `close`; for a thread of its own."""
        while True:
            with self.news:
                self.news.wait_for(lambda: not isinstance(self.task, Idle))
                task, corrections = self.task, self.edits.corrections
            if isinstance(task, Learning):
                self._learn_once(corrections)
            elif isinstance(task, Computing):
                self._compute_once(task.number, corrections)
            else:
                return

    def _learn_once(self, corrections: Corrections) -> None:
        def is_old() -> bool:
            return not isinstance(self.task, Learning) or self.task.is_cancelled

        problem, is_learned = self.page_state.problem, False
        try:
            self._learner().learn(corrections, is_old, self._tell_learning)
            is_learned = True
        except Cancelled:
            pass
        except InputError as error:
            problem = str(error)
        except Exception as error:  # nor over this
            problem = f"Nothing was learned ({type(error).__name__}: {error})."
        with self.news:
            self.page_state = replace(self.page_state, problem=problem)
            if isinstance(self.task, Learning):
                self.task = Computing(next(self._numbers)) if is_learned else self.task.then
            self._notify()

    def _tell_learning(self, doing: str) -> None:
        with self.news:
            if isinstance(self.task, Learning):
                self.task = replace(self.task, doing=doing)
                self._notify()

    def _compute_once(self, number: int, corrections: Corrections) -> None:
        told = time.monotonic()  # what is done at once, needs no words

        def is_asked(task: Task) -> bool:
            return isinstance(task, Computing) and task.number == number

        def is_old() -> bool:
            return not (is_asked(self.task) or isinstance(self.task, Idle))  # idle once the first update is there

        def tell(doing: str) -> None:
            nonlocal told
            if (now := time.monotonic()) - told >= STEP_SECONDS:
                told = now
                with self.news:
                    if is_asked(self.task):
                        self.task = Computing(number, doing)
                        self._notify()

        def publish(update: Update, problem: str) -> None:
            with self.news:
                self._notify()
                self.page_state = PageState(update, problem, self.number)
                if is_asked(self.task):
                    self.task = Idle()
                elif isinstance(self.task, Learning) and is_asked(self.task.then):
                    self.task = replace(self.task, then=Idle())

        try:
            with running(report=tell):
                for update in self.opened.updates(corrections, is_old):
                    publish(update, " ".join([self.edits.notice, *update.messages]).strip())
            return
        except Cancelled:
            return
        except InputError as error:
            problem = str(error)
        except Exception as error:  # the user must not lose the page over what one list of edits does
            problem = f"This could not be computed ({type(error).__name__}: {error}); your edits are saved."
        publish(Update(self.page_state.update.news, [""] * len(corrections.edits), []), problem)

    def _compute_anew(self) -> None:
        """Ask for the consequences of the edits, after learning if the detector learns; the caller holds the lock."""
        wanted = Computing(next(self._numbers))
        if isinstance(self.task, Learning):
            self.task = replace(self.task, then=wanted)
        elif not isinstance(self.task, Closed):
            self.task = wanted
        self.news.notify_all()

    def _notify(self) -> None:
        self.number += 1
        self.news.notify_all()

    def state(self, after: int) -> dict[str, Any]:
        """State of the page, and the name of the edits that are saved (`revision`): at once for an `after` below 0,
        otherwise as soon as there is something newer."""
        with self.news:
            end = time.monotonic() + WAIT_SECONDS
            while 0 <= after >= self.number and not isinstance(self.task, Closed) and time.monotonic() < end:
                if self.edits.is_changed():
                    break
                self.news.wait(LOOK_SECONDS)
            task, page = self.task, self.page_state
            return {
                "number": self.number,
                "revision": self.edits.name,
                "isComputing": isinstance(task.then if isinstance(task, Learning) else task, Computing),
                "doing": task.doing if isinstance(task, Computing) else "",
                "isChanged": self.edits.is_changed(),
                "problem": page.problem,
                "outcomes": page.update.outcomes,
                "update": page.update.news if page.number > after else None,
                "learning": self._describe_learning(task.doing if isinstance(task, Learning) else ""),
                "making": self.making or "",
            }

    def _describe_learning(self, doing: str) -> dict[str, Any] | None:
        if (learner := self.opened.learner) is None:
            return None
        seconds = LEARN_SECONDS + LEARN_SECONDS_PER_PHOTO * len(learner.scene.views)
        return {"now": doing, "isLearned": learner.learned is not None, "seconds": seconds}

    def _learner(self) -> OpenResult:
        if (learner := self.opened.learner) is None:
            raise Refused(HTTPStatus.CONFLICT, "No detector found these masks, so there is none that could learn.")
        return learner

    def learn(self) -> dict[str, Any]:
        """Let the detector learn the leaves that the views agree about, and those that the user outlined, see
        `OpenResult.learn`; `state` says how far it is. Raises Refused: there is no detector; it learns already, or the
        whole result is being made."""
        with self.news:
            self._learner()
            self._refuse_while_learning()
            if self.making is not None:
                raise Refused(HTTPStatus.CONFLICT, "The whole result is being made: wait until it is there.")
            if isinstance(self.task, Idle | Computing):
                self.task = Learning("looking for what to learn from", then=self.task)
            self._notify()
        return {}

    def cancel(self) -> dict[str, Any]:
        """Learn no further; all stays as it was."""
        with self.news:
            if isinstance(self.task, Learning):
                self.task = replace(self.task, is_cancelled=True)
        return {}

    def unlearn(self) -> dict[str, Any]:
        """Go back to the detector before it learned. Raises Refused: there is no detector; it learns."""
        with self.news:
            self._refuse_while_learning()
            if (learner := self._learner()).learned is not None:
                learner.learned = None
                self._compute_anew()
                self._notify()
        return {}

    def _refuse_while_learning(self) -> None:
        if isinstance(self.task, Learning):
            raise Refused(HTTPStatus.CONFLICT, "The detector is learning: wait until it is done, or cancel it.")

    def whole(self) -> dict[str, Any]:
        """Make the whole result with the saved edits, and with the learned weights, in its place, by a process of its
        own; `state` says how far it is. Then the page is that of the new result.

        Raises:
            Refused: it is being made already, or the detector learns.
            InputError: the run ended with an error; its sentence.
        """
        with self.news:
            if self.making is not None:
                raise Refused(HTTPStatus.CONFLICT, "The whole result is being made already.")
            self._refuse_while_learning()
            self.edits.begin()
            self.making = ""
        try:
            with TemporaryDirectory() as place:
                words = [*self.opened.again(Path(place)), "--corrections", str(self.edits.path.resolve())]
                returncode, sentence = run_command(words, self._tell_making)
            with self.news:
                self.edits.write_again()
            if returncode:
                raise InputError(sentence or "the run was stopped")
            opened = self.opened.reopened()
            with self.news:
                self.opened = opened
                self.page_state = replace(self.page_state, update=replace(self.page_state.update, news=None))
                self._compute_anew()
        finally:
            self._tell_making(None)
        return {}

    def _tell_making(self, step: str | None) -> None:
        with self.news:
            self.making = step
            self._notify()

    def close(self) -> None:
        with self.news:
            self.task = Closed()
            self.news.notify_all()
