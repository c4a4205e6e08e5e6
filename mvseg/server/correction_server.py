"""The page "Correct" of one result at 127.0.0.1: saves each edit at once, and shows the consequences.

It can be reached from this machine only, and only with the token in its address: requests that name another host or
come from another page's origin are refused, which keeps out other users' browsers and pages that rebind their name.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from pydantic import BaseModel, Field

from mvseg.corrections.file import MOST_BYTES, Corrections, Point, name_edits, parse_corrections, write_corrections
from mvseg.corrections.rough_outline import refine_outline
from mvseg.corrections.same_scene import check_made_for, mark_photos, with_marks
from mvseg.errors import InputError, InputWarning
from mvseg.formats.lens import photo_from_pinhole, pinhole_from_photo
from mvseg.results.report.page import build_page, describe_update
from mvseg.results.report.pictures import draw_picture
from mvseg.server.open_result import CORRECTIONS_FILE, OpenResult
from mvseg.system.running import Cancelled

HOST = "127.0.0.1"
WAIT_SECONDS = 20.0  # that a page's question for news stays open
LOOK_SECONDS = 1.0  # until it looks again whether another program has changed the edits
MOST_CORNERS = 10_000
LEARN_SECONDS, LEARN_SECONDS_PER_PHOTO = 90, 6  # that learning takes on two cores, which the page says before
CHANGED = "corrections.json was changed by another program since this page was loaded."


class Refused(Exception):
    """A request that is not answered, with the status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class _Rough(BaseModel):
    view: str
    polygon: Annotated[list[Point], Field(min_length=3, max_length=MOST_CORNERS)]


class Corrector:
    """One open result, its newest edits, and a thread that computes their consequences; the newest edits win.

    The same thread lets the detector learn: what is edited meanwhile is saved, and computed afterwards.
    """

    def __init__(self, opened: OpenResult) -> None:
        """Raises InputError: the corrections saved in the folder, or a photo, cannot be read, or they are another
        scene's."""
        self.opened = opened
        self.written, self.marks = self._stamp(), mark_photos(opened.photos)
        self.corrections, self.notice = self._read_edits()
        self.shown = opened.saved_result()
        photos, views = opened.photos, range(len(opened.scene.views))
        self.pictures = [draw_picture(photos(view), self.shown.masks, view=view, is_whole=True) for view in views]
        self.news = threading.Condition()
        self.wanted, self.computed = 1, 0
        self.number, self.updated = 0, 0  # of all news, and of the newest result among them
        self.learning, self.is_cancelled = "", False  # what is done of it, "" for nothing
        self.problem, self.outcomes = self.notice, [""] * len(self.corrections.edits)
        self.update: dict[str, Any] | None = None
        self.is_closing = False
        self.making_whole = threading.Lock()

    def page(self) -> bytes:
        """The page with the newest result, and with all edits that were saved: a reload must not lose any; nor those
        that another program has written to the file since."""
        with self.news:
            self._take_changes()
            shown, pictures = replace(self.shown, corrections=self.corrections), self.pictures
        return build_page(shown, pictures, run=self.opened.run.said.as_json(), is_served=True).encode()

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
            corrections = with_marks(corrections, self.opened.scene, self.marks)
            write_corrections(self.opened.folder / CORRECTIONS_FILE, corrections)
            self.corrections, self.written = corrections, self._stamp()
            self.wanted += 1
            self.news.notify_all()
        return {"saved": len(corrections.edits), "revision": name}

    def _read_edits(self) -> tuple[Corrections, str]:
        """The edits in the folder, and what a person should know of them."""
        found = self.opened.saved_corrections()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            check_made_for(found, self.opened.photos)
        return found, " ".join(filter(None, (self.opened.notice, *(f"{each.message}." for each in caught))))

    def _stamp(self) -> tuple[int, int] | None:
        """What changes when the file of the edits does; None without one."""
        try:
            about = (self.opened.folder / CORRECTIONS_FILE).stat()
        except OSError:
            return None
        return about.st_mtime_ns, about.st_size

    def _is_changed(self) -> bool:
        """Whether another program has written other edits to the file. (One that was deleted is written again.)"""
        stamp = self._stamp()
        if stamp in (None, self.written):
            return False
        try:
            found = self.opened.saved_corrections()
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
            self.corrections, self.notice = self._read_edits()
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
            self.opened.learn(corrections, lambda: self.is_closing or self.is_cancelled, self._tell)
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

    def _tell(self, said: str) -> None:
        with self.news:
            self.learning = said
            self._notify()

    def _notify(self) -> None:
        """There is something new to hear of, for whoever holds the lock."""
        self.number += 1
        self.news.notify_all()

    def _compute_once(self, wanted: int, corrections: Corrections) -> None:
        outcomes, news = [""] * len(corrections.edits), (self.shown, self.pictures, self.update)
        try:
            shown, outcomes, messages = self.opened.recompute(
                corrections, lambda: self.is_closing or bool(self.learning) or self.wanted > wanted
            )
            sizes = shown.scene.cameras.sizes.tolist()
            pictures = [
                picture.with_masks(shown.masks, view=view, size=tuple(sizes[view]))
                for view, picture in enumerate(self.pictures)
            ]
            news = shown, pictures, describe_update(shown, pictures)
            problem = " ".join([self.notice, *messages]).strip()
        except Cancelled:
            return
        except InputError as error:
            problem = str(error)
        except Exception as error:  # the person must not lose the page over what one list of edits does
            problem = f"This could not be computed ({type(error).__name__}: {error}); your edits are saved."
        with self.news:
            self.shown, self.pictures, self.update = news
            self.problem, self.outcomes, self.computed = problem, outcomes, wanted
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
                "isChanged": self._is_changed(),
                "problem": self.problem,
                "outcomes": self.outcomes,
                "update": self.update if self.updated > after else None,
                "learning": self._describe_learning() if self.opened.can_learn else None,
            }

    def _describe_learning(self) -> dict[str, Any]:
        seconds = LEARN_SECONDS + LEARN_SECONDS_PER_PHOTO * len(self.opened.scene.views)
        return {"now": self.learning, "isLearned": self.opened.learned is not None, "seconds": seconds}

    def learn(self) -> dict[str, Any]:
        """Let the detector learn the leaves that the views agree about, and those that a person outlined, see
        `OpenResult.learn`; `state` says how far it is.

        Raises:
            Refused: there is no detector; it learns already, or the whole result is being made.
        """
        with self.news:
            if not self.opened.can_learn:
                raise Refused(HTTPStatus.CONFLICT, "No detector found these masks, so there is none that could learn.")
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
            Refused: it learns.
        """
        with self.news:
            self._refuse_while_learning()
            if self.opened.learned is not None:
                self.opened.learned = None
                self.wanted += 1
                self._notify()
        return {}

    def _refuse_while_learning(self) -> None:
        if self.learning:
            raise Refused(HTTPStatus.CONFLICT, "The detector is learning: wait until it is done, or cancel it.")

    def outline(self, text: bytes) -> dict[str, Any]:
        """An outline of what lies in a rough one, both in pixels of the user's photo.

        Raises:
            InputError: a request of another form, no such view, or nothing to outline.
        """
        scene = self.opened.scene
        try:
            asked = _Rough.model_validate_json(text)
            view = [each.name for each in scene.views].index(asked.view)
        except ValueError:
            what = '{"view": name of a photo, "polygon": [[x, y], ...]}'
            raise InputError(f"expected {what}, 3 to {MOST_CORNERS} points in the photo") from None
        rough = np.array(asked.polygon)
        lens, K = scene.views[view].lens, scene.cameras.K[view].cpu().numpy()
        straight = rough if lens is None else pinhole_from_photo(lens, K, rough)
        if not np.isfinite(straight).all():
            raise InputError("the rough outline leaves what the lens shows")
        found = refine_outline(self.opened.photos(view), straight)
        placed = found if lens is None else photo_from_pinhole(lens, K, found)
        return {"polygon": np.round(placed, 2).tolist()}

    def whole(self) -> dict[str, Any]:
        """Make the whole result with the saved edits, and with what was learned, in its place, by a process of its own,
        and say where it is.

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
                write_corrections(path, self.corrections)
                self.written, before = self._stamp(), self.corrections
            with TemporaryDirectory() as place:
                words = ["infer", "--again", str(folder), *self.opened.again_with(Path(place))]
                command = [sys.executable, "-m", "mvseg.cli", *words, "--corrections", str(path), "--quiet"]
                run = subprocess.run(command, capture_output=True, text=True, check=False)
            with self.news:
                self._keep_newer(before)
        finally:
            self.making_whole.release()
        if run.returncode:
            raise InputError((run.stderr.strip().splitlines() or ["the run was stopped"])[-1])
        return {"said": run.stdout.strip()}

    def _keep_newer(self, before: Corrections) -> None:
        """After the folder was replaced: edits that were saved meanwhile may have lain in the one before, and are
        written again; but over `before` only, not over those of another program."""
        try:
            names = {name_edits(each.edits) for each in (before, self.opened.saved_corrections())}
        except InputError:  # theirs, and broken: `_is_changed` says so
            return
        if len(names) == 1:
            write_corrections(self.opened.folder / CORRECTIONS_FILE, self.corrections)
            self.written = self._stamp()

    def close(self) -> None:
        """Let everybody who waits go."""
        with self.news:
            self.is_closing = True
            self.news.notify_all()


class CorrectionServer(ThreadingHTTPServer):
    """Serves one `Corrector` on a free port of this machine.

    Attributes:
        token: part of every address that is answered.
        address: of the page.
    """

    daemon_threads = True

    def __init__(self, corrector: Corrector, port: int = 0) -> None:
        self.corrector, self.token = corrector, secrets.token_urlsafe(24)
        super().__init__((HOST, port), _Handler)
        self.address = f"http://{HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed meanwhile is no news."""


class _Handler(BaseHTTPRequestHandler):
    server: CorrectionServer
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        corrector, is_number = self.server.corrector, re.compile("[0-9]{1,15}").fullmatch

        def state() -> None:
            asked = self._asked("after")
            self._json(corrector.state(int(asked) if is_number(asked) else -1))

        self._answer({"": lambda: self._send(corrector.page(), "text/html; charset=utf-8"), "state": state})

    def do_PUT(self) -> None:
        self._answer({"edits": lambda: self._json(self.server.corrector.save(self._body(), self._asked("base")))})

    def do_POST(self) -> None:
        corrector = self.server.corrector
        self._answer(
            {
                "outline": lambda: self._json(corrector.outline(self._body())),
                "whole": lambda: self._json(corrector.whole()),
                "learn": lambda: self._json(corrector.learn()),
                "cancel": lambda: self._json(corrector.cancel()),
                "unlearn": lambda: self._json(corrector.unlearn()),
            }
        )

    def _answer(self, places: Mapping[str, Callable[[], None]]) -> None:
        try:
            if (place := self._place()) not in places:
                raise Refused(HTTPStatus.NOT_FOUND, "There is nothing here.")
            places[place]()
        except Refused as error:
            self._json({"problem": str(error)}, error.status)
        except InputError as error:
            self._json({"problem": str(error)}, HTTPStatus.BAD_REQUEST)
        except ConnectionError:
            self.close_connection = True
        except OSError as error:
            folder = self.server.corrector.opened.folder
            sentence = f"{folder}: the edit could not be saved ({error.strerror})"
            self._json({"problem": sentence}, HTTPStatus.INTERNAL_SERVER_ERROR)

    def _place(self) -> str:
        """The requested path, below the token.

        Raises:
            Refused: by another name of this machine, from another page, without the token, or no address at all.
        """
        own = f"{HOST}:{self.server.server_port}"
        origin = self.headers.get("Origin")
        if self.headers.get("Host") != own or (origin is not None and origin != f"http://{own}"):
            raise Refused(HTTPStatus.FORBIDDEN, "This address is only for the page that mvseg correct opens.")
        try:
            path = urlsplit(self.path).path
        except ValueError:  # http://[
            raise Refused(HTTPStatus.BAD_REQUEST, "The address cannot be read.") from None
        token, _, place = path.lstrip("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            raise Refused(HTTPStatus.FORBIDDEN, "The token is missing or old: open what mvseg correct prints.")
        return place

    def _asked(self, name: str) -> str:
        """What the address says after the question mark; "" for nothing."""
        return parse_qs(urlsplit(self.path).query).get(name, [""])[0]

    def _body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and len(length) < 16):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "The request does not say how long it is.")
        if int(length) > MOST_BYTES:
            raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"More than {MOST_BYTES // 2**20} MiB are not read.")
        return self.rfile.read(int(length))

    def _json(self, content: Mapping[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        if status != HTTPStatus.OK:
            self.close_connection = True  # what was sent may not have been read
        self._send(json.dumps(content, default=str).encode(), "application/json", status)

    def _send(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store",
                   "X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer",
                   "Cross-Origin-Resource-Policy": "same-origin"}  # fmt: skip
        for name, value in (headers | ({"Connection": "close"} if self.close_connection else {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """The terminal is for the person: nothing."""
