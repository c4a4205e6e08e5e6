"""A page at 127.0.0.1 that corrects something.

It can be reached from this machine only, and only with the token in its address: requests that name another host or
come from another page's origin are refused, which keeps out other users' browsers and pages that rebind their name.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs

from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.server.correction_server import Corrector
from mvseg.server.saved_edits import Refused

HOST = "127.0.0.1"


class CorrectionServer(ThreadingHTTPServer):
    """Serves one `Corrector` on a free port of this machine; the `token` is part of every address that is answered."""

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
        corrector, after = self.server.corrector, self._asked("after")
        number = int(after) if re.fullmatch("[0-9]{1,15}", after) else -1
        self._answer({"": corrector.page, "state": partial(corrector.state, number)})

    def do_PUT(self) -> None:
        self._answer({"edits": lambda: self.server.corrector.save(self._body(), self._asked("base"))})

    def do_POST(self) -> None:
        corrector = self.server.corrector
        places: dict[str, Callable[[], Mapping[str, Any]]] = {
            each.__name__: each for each in (corrector.whole, corrector.learn, corrector.cancel, corrector.unlearn)
        }
        for place, answer in corrector.opened.answers.items():
            places[place] = partial(lambda answer: answer(self._body()), answer)
        self._answer(places)

    def _answer(self, places: Mapping[str, Callable[[], bytes | Mapping[str, Any]]]) -> None:
        try:
            if (place := self._place()) not in places:
                raise Refused(HTTPStatus.NOT_FOUND, "There is nothing here.")
            answer = places[place]()
            if isinstance(answer, bytes):
                self._send(answer, "text/html; charset=utf-8")
            else:
                self._json(answer)
        except Refused as error:
            self._json({"problem": str(error)}, error.status)
        except InputError as error:
            self._json({"problem": str(error)}, HTTPStatus.BAD_REQUEST)
        except ConnectionError:
            self.close_connection = True
        except OSError as error:
            sentence = f"{self.server.corrector.opened.folder}: the edit could not be saved ({error.strerror})"
            self._json({"problem": sentence}, HTTPStatus.INTERNAL_SERVER_ERROR)

    def _place(self) -> str:
        """The path below the token. Raises Refused: another name, origin or token."""
        own = f"{HOST}:{self.server.server_port}"
        origin = self.headers.get("Origin")
        if self.headers.get("Host") != own or (origin is not None and origin != f"http://{own}"):
            raise Refused(HTTPStatus.FORBIDDEN, "This address is only for the page that mvseg correct opens.")
        token, _, place = self.path.partition("?")[0].lstrip("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            raise Refused(HTTPStatus.FORBIDDEN, "The token is missing or old: open what mvseg correct prints.")
        return place

    def _asked(self, name: str) -> str:
        return parse_qs(self.path.partition("?")[2]).get(name, [""])[0]

    def _body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and len(length) < 16):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "The request does not say how long it is.")
        if int(length) > (most := EDITS.most_bytes):
            raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"More than {most // 2**20} MiB are not read.")
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
        """The terminal is for the user: nothing."""
