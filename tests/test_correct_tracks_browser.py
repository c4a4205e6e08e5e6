"""`mvseg correct TRACKS` as a person uses it, in a real browser. Skipped without chromium."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from mvseg.server.open_tracks import OpenTracks
from report_browser import CHROMIUM, NO_WEBGL, WAIT_MS, sync_api
from served_result import serve, write_two_ways

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")]
PLACE = """([date, leaf]) => {
  const canvas = document.querySelectorAll("#dates canvas")[date], box = canvas.getBoundingClientRect();
  const { shape } = data.leaves.find((one) => one.date === date && one.leaf === leaf);
  const [x, y] = middleOf(project(shape, find("turn").value * Math.PI / 180));
  return [box.left + x, box.top + y];
}"""

MIDDLE = """(path) => {
  const { x, y } = path.getPointAtLength(path.getTotalLength() / 2).matrixTransform(path.getScreenCTM());
  return [x, y];
}"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[sync_api.Page, Path]]:
    folder = write_two_ways(tmp_path_factory.mktemp("two ways"))
    with serve(OpenTracks(folder)) as server, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=NO_WEBGL)
        shown = browser.new_page(viewport={"width": 1280, "height": 900})
        shown.set_default_timeout(WAIT_MS)
        problems: list[str] = []
        shown.on("pageerror", lambda error: problems.append(str(error)))
        shown.goto(server.address)
        yield shown, folder
        browser.close()
        assert problems == []


def settle(shown: sync_api.Page) -> None:
    """Until all that follows from the edits is shown."""
    shown.wait_for_function("() => !work.server.unsaved && !work.server.isComputing && work.server.number > 0")


def pairs(shown: sync_api.Page) -> dict[int, int]:
    """{leaf of the first date: leaf of the second one}."""
    return dict(shown.evaluate("work.pairs().map((pair) => pair.map((leaf) => leaf.leaf))"))


def saved(folder: Path) -> list[str]:
    path = folder / "corrections.json"
    return [edit["op"] for edit in json.loads(path.read_text())["edits"]] if path.is_file() else []


def test_a_person_mends_links(page: tuple[sync_api.Page, Path]) -> None:
    shown, folder = page
    settle(shown)
    now = pairs(shown)
    behind = {leaf: 1 + (other + 2) % 6 for leaf, other in now.items()}
    # a leaf on one date, then one on another
    shown.mouse.click(*shown.evaluate(PLACE, [0, 1]))
    assert shown.locator("#ask h2").inner_text() == "leaf 1 of day 0"
    assert shown.locator("#ask .history img").count() == 2
    shown.mouse.click(*shown.evaluate(PLACE, [1, behind[1]]))
    settle(shown)
    assert pairs(shown) == behind
    assert saved(folder) == ["same_track"]
    listed = shown.locator("#said li").all_inner_texts()[0]
    assert listed.startswith("leaf 1 of day 0 = leaf 1 of day 1")
    assert shown.locator("#note").inner_text().startswith("leaf 1 of day 0 = leaf 1 of day 1.")  # the same numbers
    # undo
    shown.keyboard.press("u")
    settle(shown)
    assert pairs(shown) == now
    assert saved(folder) == []
    # a link
    line = shown.locator("#links g").first.locator(".reach")
    at = line.evaluate(MIDDLE)
    shown.mouse.click(*at)
    settle(shown)
    assert pairs(shown) == behind
    assert saved(folder) == ["different_track"]
    # what was saved is there after a reload, and can be taken back
    shown.reload()
    settle(shown)
    assert pairs(shown) == behind
    shown.get_by_label("delete edit 1").click()
    settle(shown)
    assert pairs(shown) == now


def test_questions_are_answered_by_keys(page: tuple[sync_api.Page, Path]) -> None:
    shown, folder = page
    settle(shown)
    now = pairs(shown)
    shown.locator("#ask li").first.wait_for()
    assert "is turned by" in shown.locator("#ask li").first.inner_text()
    before = shown.locator("#ask h2").inner_text()
    shown.keyboard.press("n")
    assert shown.locator("#ask h2").inner_text() != before
    shown.keyboard.press("d")
    settle(shown)
    assert pairs(shown) == {leaf: 1 + (other + 2) % 6 for leaf, other in now.items()}
    shown.keyboard.press("u")
    settle(shown)
    shown.keyboard.press("s")
    settle(shown)
    assert pairs(shown) == now
    assert saved(folder) == ["same_track"]
    # leaves and links of the table, too
    shown.keyboard.press("u")
    settle(shown)
    shown.locator("td .link").first.focus()
    shown.keyboard.press("Enter")
    settle(shown)
    assert saved(folder) == ["different_track"]
    shown.keyboard.press("u")
    settle(shown)
    for cell in ("leaf 2 of day 0", "leaf 3 of day 1"):
        shown.get_by_role("button", name=cell, exact=True).focus()
        shown.keyboard.press("Enter")
    settle(shown)
    assert saved(folder) == ["same_track"]
