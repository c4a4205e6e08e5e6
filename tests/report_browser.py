"""A browser for the tests of the pages, and a page that is open in it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sync_api = pytest.importorskip("playwright.sync_api")
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for path in map(shutil.which, NAMES) if path), None)
OPTIONS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
NO_WEBGL = ["--disable-gpu", "--disable-3d-apis", "--no-sandbox"]
BLANK = "about:blank"
WAIT_MS = 60_000  # WebGL without a GPU, on a busy machine


def browser_with(*options: str) -> Callable[..., Any]:
    """The fixture `browser` of a module."""

    @pytest.fixture(scope="module")
    def browser() -> Iterator[sync_api.Browser]:
        with sync_api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options, timeout=WAIT_MS)
            yield browser
            browser.close()

    return browser


class Opened:
    """A page that is open, and what it asked for or complained of.

    The pages of a browser are shown by one tab, one after another: in a tab of its own, each takes twice as long.
    """

    def __init__(self, browser: sync_api.Browser, file: Path, size: tuple[int, int], *, has_space: bool = True) -> None:
        if browser.contexts and browser.contexts[0].pages[0].url != BLANK:  # a test has failed and left it
            browser.contexts[0].close()
        self.context = browser.contexts[0] if browser.contexts else browser.new_context(offline=True)
        self.page = self.context.pages[0] if self.context.pages else self.context.new_page()
        self.page.set_default_timeout(WAIT_MS)
        self.page.set_viewport_size({"width": size[0], "height": size[1]})
        self.problems: list[str] = []
        self.listeners: dict[Any, Callable[..., None]] = {
            "console": self._hear,
            "pageerror": lambda error: self.problems.append(str(error)),
            "request": self._see,
            "dialog": lambda dialog: self.problems.append(dialog.message),
        }
        for event, listener in self.listeners.items():
            self.page.on(event, listener)
        self.page.goto(file.as_uri())
        if has_space:
            self.page.wait_for_function("() => Number(document.getElementById('canvas').dataset.frames) > 0")

    def close(self) -> None:
        self.page.evaluate("window.localStorage.clear()")
        self.page.mouse.move(0, 0)
        self.page.goto(BLANK)
        for event, listener in self.listeners.items():
            self.page.remove_listener(event, listener)
        assert self.problems == []

    def _hear(self, message: sync_api.ConsoleMessage) -> None:
        if message.type == "error" and "WebGL" not in message.text:
            self.problems.append(message.text)

    def _see(self, request: sync_api.Request) -> None:
        if not request.url.startswith(("data:", "blob:")) and request.resource_type != "document":
            self.problems.append(request.url)
