"""A browser for the tests of the pages, and a page that is open in it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

sync_api = pytest.importorskip("playwright.sync_api")
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for path in map(shutil.which, NAMES) if path), None)
OPTIONS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
NO_WEBGL = ["--disable-gpu", "--disable-3d-apis", "--no-sandbox"]
WAIT_MS = 60_000  # WebGL without a GPU, on a busy machine


class Opened:
    """A page that is open, and what it asked for or complained of."""

    def __init__(self, browser: sync_api.Browser, file: Path, size: tuple[int, int], *, has_space: bool = True) -> None:
        self.context = browser.new_context(viewport={"width": size[0], "height": size[1]}, offline=True)
        self.context.set_default_timeout(WAIT_MS)
        self.problems: list[str] = []
        self.page = self.context.new_page()
        self.page.on("console", self._hear)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", self._see)
        self.page.on("dialog", lambda dialog: self.problems.append(dialog.message))
        self.page.goto(file.as_uri())
        if has_space:
            self.page.wait_for_function("() => Number(document.getElementById('canvas').dataset.frames) > 0")

    def close(self) -> None:
        self.context.close()
        assert self.problems == []

    def _hear(self, message: sync_api.ConsoleMessage) -> None:
        if message.type == "error" and "WebGL" not in message.text:
            self.problems.append(message.text)

    def _see(self, request: sync_api.Request) -> None:
        if not request.url.startswith(("data:", "blob:")) and request.resource_type != "document":
            self.problems.append(request.url)
