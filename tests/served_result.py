"""A result that `mvseg correct` serves, and what its page asks."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from mvseg.cli import main
from mvseg.corrections.file import Corrections, name_edits
from mvseg.pipeline.plant import Plant, match_given
from mvseg.results.result import Learned
from mvseg.server.correction_server import Corrector
from mvseg.server.local_server import CorrectionServer
from mvseg.server.open_result import OpenResult
from mvseg.server.open_tracks import OpenTracks
from mvseg.system.running import Cancelled, progress_bar
from tests.plants_over_days import opposite_leaves, turned, write_result

WAIT = 60.0  # seconds, on a busy machine


def write_two_ways(folder: Path) -> Path:
    """Tracks of a plant on two dates that looks the same from behind: each link may as well be to the leaf behind."""
    for name, degrees in (("a", 0), ("b", 40)):
        write_result(folder / name, turned(opposite_leaves(3), degrees))
    results, out = [str(folder / name) for name in ("a", "b")], str(folder / "tracks")
    assert main(["track", *results, "--times", "0", "1", "--pots", "turned", "--out", out, "--quiet"]) == 0
    return folder / "tracks"


@contextmanager
def serve(what: Path | OpenTracks) -> Iterator[CorrectionServer]:
    """The server of a result folder, or of tracks, which computes, too."""
    corrector = Corrector(OpenResult(what) if isinstance(what, Path) else what)
    with CorrectionServer(corrector) as server:
        works = partial(server.serve_forever, poll_interval=0.02), corrector.compute
        threads = [threading.Thread(target=work) for work in works]
        for thread in threads:
            thread.start()
        yield server
        corrector.close()
        server.shutdown()
        for thread in threads:
            thread.join()


class Lesson:
    """Stands in for `OpenResult.learn`: it tells of a step, and ends when it is told to, or cancelled."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go_on, self.learned_from = threading.Event(), list[Corrections]()

        def learn(
            opened: OpenResult, corrections: Corrections, is_old: Callable[[], bool], report: Callable[[str], None]
        ) -> None:
            self.learned_from.append(corrections)
            report("learning: step 30 of 75")
            while not self.go_on.wait(0.02):
                if is_old():
                    raise Cancelled
            plant, said = opened._plant_before
            opened.learned = replace(plant, learned=Learned(weights=b"learned", rounds=1)), said

        monkeypatch.setattr(OpenResult, "learn", learn)
        monkeypatch.setattr(OpenResult, "learner", property(lambda opened: opened))


class SlowLook:
    """A result that says of each of two steps what it does, and waits there until `go_on`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go_on = [threading.Event(), threading.Event()]

        def look(opened: OpenResult) -> tuple[Plant, list[str]]:
            for go_on in progress_bar(self.go_on, "detection", unit="view"):
                assert go_on.wait(WAIT)
            return match_given(opened.opened), []

        monkeypatch.setattr(OpenResult, "_plant_before", property(look))
        monkeypatch.setattr("mvseg.server.correction_server.STEP_SECONDS", 0.0)


def ask(
    server: CorrectionServer, method: str, place: str, body: bytes | None = None, **headers: str
) -> tuple[int, Any]:
    """Status and content of an answer; `place` below the token, or from the root where it begins with "/"."""
    address = urlsplit(server.address)
    connection = http.client.HTTPConnection(address.netloc, timeout=WAIT)
    path = place if place.startswith("/") else address.path + place
    connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    is_json = answer.headers["Content-Type"] == "application/json"
    return answer.status, json.loads(text) if is_json else text.decode()


def text_of(edits: list[dict[str, Any]]) -> bytes:
    return json.dumps({"format": "mvseg-corrections/1", "edits": edits}).encode()


def save(server: CorrectionServer, edits: list[dict[str, Any]]) -> tuple[int, Any]:
    """Save edits as a page does that knows those before."""
    return save_text(server, text_of(edits))


def save_text(server: CorrectionServer, body: bytes) -> tuple[int, Any]:
    base = name_edits(server.corrector.edits.corrections.edits)
    return ask(server, "PUT", f"edits?base={base}", body)


def wait_until_computed(server: CorrectionServer) -> dict[str, Any]:
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        status, state = ask(server, "GET", "state")
        assert status == 200
        if not state["isComputing"]:
            return dict(state)
        time.sleep(0.02)
    raise AssertionError("nothing was computed")


def wait_for_news(server: CorrectionServer, state: dict[str, Any]) -> dict[str, Any]:
    return dict(ask(server, "GET", f"state?after={state['number']}")[1])
