"""`mvseg correct` as a person uses it, in a real browser: edit, reload, edit. Skipped without chromium."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mvseg.config import RunConfig
from mvseg.runs.one_scene import run_one_scene
from mvseg.runs.request import RunRequest
from mvseg.server.local_server import CorrectionServer
from report_browser import CHROMIUM, NO_WEBGL, WAIT_MS, browser_with, sync_api
from scene_folders import write_scene
from served_result import Lesson, SlowLook, serve, text_of

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")]


browser = browser_with(*NO_WEBGL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A result of three balls in four views, ids only."""
    scene = write_scene(tmp_path / "balls")
    run_one_scene(RunRequest(scene, scene / "masks", tmp_path / "result", RunConfig(reconstruct=None)))
    return tmp_path / "result"


@pytest.fixture
def served(folder: Path) -> Iterator[CorrectionServer]:
    with serve(folder) as server:
        yield server


class Tab:
    """A tab of the browser with the page."""

    def __init__(self, browser: sync_api.Browser, server: CorrectionServer) -> None:
        self.page = browser.new_page(viewport={"width": 1280, "height": 800})
        self.page.set_default_timeout(WAIT_MS)
        self.page.goto(server.address)

    def press_on(self, pane: int, leaf: int, key: str) -> None:
        """Click a leaf's mask, then a key."""
        place = """([pane, leaf]) => {
          const { picture, view } = modes.work.panes[pane];
          const [x, y] = data.views[view].masks.find((mask) => mask.leaf === leaf).at;
          const at = new DOMPoint(x, y).matrixTransform(picture.getScreenCTM());
          return [at.x, at.y];
        }"""
        self.page.mouse.click(*self.page.evaluate(place, [pane, leaf]))
        self.page.keyboard.press(key)

    def wait_for(self, text: str) -> None:
        self.page.locator("#correct-side").get_by_text(text).first.wait_for()

    def rows(self) -> list[str]:
        """The edits in the list, the first one first."""
        return [text.split("\n")[0] for text in self.page.locator("#correct-list li").all_inner_texts()][::-1]


def ops(folder: Path) -> list[str]:
    return [edit["op"] for edit in edits_of(folder)]


def edits_of(folder: Path) -> list[dict[str, Any]]:
    edits: list[dict[str, Any]] = json.loads((folder / "corrections.json").read_text())["edits"]
    return edits


def test_edit_reload_edit(browser: sync_api.Browser, served: CorrectionServer, folder: Path) -> None:
    tab = Tab(browser, served)
    tab.wait_for("What you see follows from all edits.")
    tab.press_on(0, 1, "r")
    tab.wait_for("What you see follows from all edits.")
    assert "11 masks" in tab.page.locator("#summary").inner_text()
    tab.page.reload()
    tab.wait_for("What you see follows from all edits.")
    assert [row.startswith("no leaf") for row in tab.rows()] == [True]
    assert tab.page.evaluate("[data.numMasks, modes.work.data.numMasks]") == [12, 11]
    tab.press_on(0, 2, "c")
    tab.wait_for("What you see follows from all edits.")
    assert ops(folder) == ["reject", "confirm"]
    tab.page.get_by_label("delete edit 1").click()
    tab.wait_for("What you see follows from all edits.")
    assert ops(folder) == ["confirm"]
    tab.page.evaluate("""(() => {
      const { server } = modes.work;
      server.tell({}, "The whole result is made.");
      server.hear({ number: server.number, revision: server.base }); // no news, every 20 s
    })()""")
    tab.wait_for("The whole result is made.")
    tab.page.locator("#mode-look").click()  # the last whole result, and what is not in it
    assert "1 edit; “Make the whole result” (Correct) shows the new numbers" in tab.page.locator("#card").inner_text()
    assert tab.page.locator("#table tbody tr").count() == 3
    tab.page.close()


def test_two_tabs_never_save_over_each_other(browser: sync_api.Browser, served: CorrectionServer, folder: Path) -> None:
    one, other = Tab(browser, served), Tab(browser, served)
    other.wait_for("What you see follows from all edits.")
    other.page.evaluate("modes.work.server.hear = () => {}")  # this one sleeps: it does not hear of edits elsewhere
    one.press_on(0, 1, "r")
    one.wait_for("What you see follows from all edits.")
    other.press_on(0, 2, "c")
    other.wait_for("Not saved: Another page has changed the edits since this one was loaded.")
    assert ops(folder) == ["reject"]
    other.page.get_by_role("button", name="Reload").click()
    other.wait_for("What you see follows from all edits.")
    assert len(other.rows()) == 1
    other.press_on(0, 2, "c")
    one.wait_for("This one saves nothing any more")
    assert ops(folder) == ["reject", "confirm"]
    one.press_on(0, 2, "r")
    assert ops(folder) == ["reject", "confirm"]
    for tab in (one, other):
        tab.page.close()


def test_an_edit_that_could_not_be_saved_is_saved_later(
    browser: sync_api.Browser, served: CorrectionServer, folder: Path
) -> None:
    tab = Tab(browser, served)
    tab.wait_for("What you see follows from all edits.")
    tab.page.route("**/edits?*", lambda route: route.abort())
    tab.press_on(0, 1, "r")
    tab.wait_for("Not saved:")
    assert not (folder / "corrections.json").exists()
    with tab.page.expect_download() as download:
        tab.page.get_by_role("button", name="Save corrections.json").click()
    saved = json.loads(Path(download.value.path()).read_text())["edits"]
    assert [edit["op"] for edit in saved] == ["reject"]
    tab.page.unroute("**/edits?*")
    tab.wait_for("What you see follows from all edits.")
    assert edits_of(folder) == saved
    tab.page.close()


def test_a_file_that_another_program_has_changed_is_offered(
    browser: sync_api.Browser, served: CorrectionServer, folder: Path
) -> None:
    tab = Tab(browser, served)
    tab.wait_for("What you see follows from all edits.")
    tab.press_on(0, 1, "r")
    tab.wait_for("What you see follows from all edits.")
    (reject,) = edits_of(folder)
    (folder / "corrections.json").write_bytes(text_of([reject, reject | {"op": "confirm"}]))
    tab.wait_for("Another program has changed corrections.json.")
    tab.press_on(0, 2, "r")
    assert ops(folder) == ["reject", "confirm"]
    tab.page.get_by_role("button", name="Reload").click()
    tab.wait_for("What you see follows from all edits.")
    assert len(tab.rows()) == 2
    tab.page.close()


def test_the_page_says_what_is_computed(
    browser: sync_api.Browser, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = SlowLook(monkeypatch)
    with serve(folder) as server:
        tab = Tab(browser, server)
        for view, go_on in enumerate(look.go_on, start=1):
            tab.wait_for(f"Computing: detection: view {view} of 2")
            go_on.set()
        tab.wait_for("What you see follows from all edits.")
        tab.page.close()


def test_a_detector_learns_while_a_person_edits(
    browser: sync_api.Browser, served: CorrectionServer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lesson, tab = Lesson(monkeypatch), Tab(browser, served)
    tab.wait_for("About 2 minutes for 4 photos on two processor cores; your edits stay, and it can be undone.")
    tab.page.keyboard.press("t")
    tab.wait_for("learning: step 30 of 75")
    tab.press_on(0, 1, "r")
    tab.wait_for("1 edit saved. It is computed when the detector has learned.")
    assert ops(folder) == ["reject"]
    tab.page.get_by_role("button", name="Cancel").click()
    tab.wait_for("What you see follows from all edits.")
    tab.page.get_by_role("button", name="Learn from these leaves").click()
    tab.wait_for("learning: step 30 of 75")
    lesson.go_on.set()
    tab.wait_for("The detector has learned from these leaves.")
    assert [len(each.edits) for each in lesson.learned_from] == [0, 1]
    tab.page.get_by_role("button", name="Undo learning").click()
    tab.wait_for("About 2 minutes")
    assert len(tab.rows()) == 1
    tab.page.close()


def test_fitting_to_the_leaf_is_undone_alone(browser: sync_api.Browser, served: CorrectionServer) -> None:
    tab = Tab(browser, served)
    points = "modes.work.draft.points"
    tab.page.evaluate("""(() => {
      const { work } = modes;
      const [x1, y1, x2, y2] = data.views[0].masks[0].box;
      work.take("outline");
      const corners = [[x1 - 30, y1 - 30], [x2 + 30, y1 - 30], [x2 + 30, y2 + 30], [x1 - 30, y2 + 30]];
      work.draft = { pane: work.panes[0], kind: "outline", points: corners, isClosed: false };
      work.finish();
    })()""")
    drawn = tab.page.evaluate(points)
    tab.page.get_by_role("button", name="Fit it to the leaf").click()
    tab.page.get_by_role("button", name="As I drew it").wait_for()
    assert len(tab.page.evaluate(points)) > 4
    tab.page.get_by_role("button", name="As I drew it").click()
    assert tab.page.evaluate(points) == drawn
    assert tab.page.get_by_role("button", name="As I drew it").count() == 0
    tab.page.keyboard.press("Enter")
    tab.wait_for("drawn in one photo, found in")
    assert tab.rows()[0].startswith("outline")
    tab.page.close()
