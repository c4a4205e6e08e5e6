"""The mode "Correct" as a person uses it, in a real browser. Skipped where no chromium is installed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from mvseg.corrections.file import load_corrections
from mvseg.formats.lens import photo_from_pinhole
from mvseg.results.result import Instances, Result
from mvseg.verification.choose import RejectedCandidate
from report_browser import CHROMIUM, NO_WEBGL, Opened, browser_with, sync_api
from report_pages import HOSTILE, write_page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")]


browser = browser_with(*NO_WEBGL)  # the mode needs none


@pytest.fixture(scope="module")
def bent(balls: Result) -> Result:
    """The balls as a lens with distortion shows them; what their photos show does not matter here."""
    K, (width, height) = balls.scene.cameras.K[0].numpy(), balls.scene.cameras.sizes[0].tolist()
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], -0.9, 0.1, 0.02, -0.03]
    lens = pycolmap.Camera(model="OPENCV", width=width, height=height, params=params)
    views = tuple(replace(view, lens=lens) for view in balls.scene.views)
    return replace(balls, scene=replace(balls.scene, views=views))


@pytest.fixture(scope="module")
def file(bent: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("correct") / "report.html", bent)


@pytest.fixture
def opened(browser: sync_api.Browser, file: Path) -> Iterator[Person]:
    opened = Person(browser, file)
    yield opened
    opened.close()


class Person(Opened):
    """What a person does in the mode."""

    def __init__(self, browser: sync_api.Browser, file: Path) -> None:
        super().__init__(browser, file, (1280, 800), has_space=False)
        self.page.locator("#mode-correct").click()

    def at(self, pane: int, xy: list[float]) -> tuple[float, float]:
        """Where the screen shows a point of a picture."""
        place = """([pane, [x, y]]) => {
          const { picture } = modes.work.panes[pane];
          const at = new DOMPoint(x, y).matrixTransform(picture.getScreenCTM());
          return [at.x, at.y];
        }"""
        return tuple(self.page.evaluate(place, [pane, xy]))

    def in_picture(self, view: int, points: list[list[float]]) -> list[list[float]]:
        """Where a picture shows points of the photo."""
        place = "([view, points]) => points.map((point) => modes.work.frames[view].toPicture(point))"
        return self.page.evaluate(place, [view, points])

    def mask(self, view: int, leaf: int) -> dict[str, Any]:
        found = "([view, leaf]) => data.views[view].masks.find((mask) => mask.leaf === leaf)"
        return self.page.evaluate(found, [view, leaf])

    def click_mask(self, pane: int, leaf: int) -> None:
        view = self.page.evaluate("(pane) => modes.work.panes[pane].view", pane)
        self.page.mouse.click(*self.at(pane, self.mask(view, leaf)["at"]))

    def drag(self, pane: int, line: list[list[float]]) -> None:
        self.page.mouse.move(*self.at(pane, line[0]))
        self.page.mouse.down()
        for point in line[1:]:
            self.page.mouse.move(*self.at(pane, point), steps=4)
        self.page.mouse.up()

    def save(self, folder: Path) -> list[dict[str, Any]]:
        """The edits in the file that the page saves; mvseg reads it."""
        with self.page.expect_download() as download:
            self.page.get_by_role("button", name="Save corrections.json").click()
        path = folder / download.value.suggested_filename
        download.value.save_as(path)
        assert path.name == "corrections.json"
        assert len(load_corrections(path).edits) == self.num_edits()
        content = json.loads(path.read_text(encoding="utf-8"))
        assert content.keys() == {"format", "photos", "edits"}
        for edit in content["edits"]:
            edit.pop("when", None)
        return content["edits"]

    def num_edits(self) -> int:
        return self.page.locator("#correct-list li").count()

    def load(self, path: Path) -> str:
        self.page.locator("#correct input[type=file]").set_input_files(path)
        self.page.locator("#correct-note:not(:empty)").wait_for()
        return self.page.locator("#correct-note").inner_text()


def photo_point(result: Result, view: int, mask: dict[str, Any], box: list[float]) -> np.ndarray:
    """Where the user's photo shows the point that names a mask."""
    width = int(result.scene.cameras.sizes[view, 0])
    height = int(result.scene.cameras.sizes[view, 1])
    scale = (box[2] - box[0]) * width / 2000
    xy = np.array([[box[0] * width, box[1] * height]]) + np.array([mask["at"]]) * scale
    lens = result.scene.views[view].lens
    return xy[0] if lens is None else photo_from_pinhole(lens, result.scene.cameras.K[view].numpy(), xy)[0]


def test_two_clicks_link_masks_by_points_of_the_photos(opened: Person, bent: Result, tmp_path: Path) -> None:
    opened.click_mask(0, 1)
    opened.click_mask(1, 2)
    opened.page.keyboard.press("d")
    opened.click_mask(1, 3)
    opened.click_mask(0, 3)
    opened.page.get_by_role("button", name="The same leaf").click()
    opened.click_mask(0, 2)
    opened.page.keyboard.press("Shift+R")
    gone = "modes.work.gone.size === data.views.flatMap((view) => view.masks).filter(({ leaf }) => leaf === 2).length"
    assert opened.page.evaluate(gone)  # struck out everywhere
    opened.click_mask(0, 1)
    opened.page.keyboard.press("c")
    edits = opened.save(tmp_path)
    assert [edit["op"] for edit in edits] == ["different", "same", "reject", "confirm"]
    assert [place[0] for place in edits[1]["at"]] == [bent.scene.views[1].name, bent.scene.views[0].name]
    assert edits[2]["everywhere"] is True
    assert "everywhere" not in edits[3]
    boxes = opened.page.evaluate("data.views.map((view) => view.box)")
    for place, (view, leaf) in zip(edits[0]["at"] + edits[1]["at"], [(0, 1), (1, 2), (1, 3), (0, 3)], strict=True):
        wanted = photo_point(bent, view, opened.mask(view, leaf), boxes[view])
        np.testing.assert_allclose(place[1:], wanted, atol=0.05)


def test_an_outline_is_drawn_in_one_go_or_by_its_corners(opened: Person, tmp_path: Path) -> None:
    circle = [[1000 + 150 * np.cos(turn), 300 + 150 * np.sin(turn)] for turn in np.linspace(0, 6.1, 30)]
    opened.page.keyboard.press("o")
    opened.drag(0, circle)
    opened.page.locator("#leaf-word").fill(HOSTILE)
    opened.page.get_by_role("button", name="Keep it").click()
    opened.page.keyboard.press("o")
    corners = [[700, 200], [900, 200], [900, 400], [700, 200]]
    for corner in corners:  # the last click is on the first corner
        opened.page.mouse.click(*opened.at(1, corner))
    opened.page.keyboard.press("Enter")
    free, clicked = opened.save(tmp_path)
    assert free["leaf"] == HOSTILE
    assert len(free["polygon"]) >= 20
    assert len(clicked["polygon"]) == 3
    assert clicked["leaf"] == HOSTILE  # the name is in the field already
    sizes = opened.page.evaluate("data.correct.views[1].size"), opened.page.evaluate("data.views[1].box")
    back = opened.in_picture(1, clicked["polygon"])
    np.testing.assert_allclose(back, corners[:3], atol=2 * 2000 / (sizes[0][0] * (sizes[1][2] - sizes[1][0])))
    assert opened.page.locator("svg.work path.drawn").count() == 2
    assert opened.page.locator("#correct-list li").last.inner_text().startswith("outline drawn in")
    opened.page.keyboard.press("o")
    opened.drag(0, [[1000, 300], [1030, 300], [1015, 325], [1001, 301]])
    assert opened.page.evaluate("modes.work.draft.isClosed")


def test_a_cut_goes_through_the_mask_that_it_crosses(opened: Person, tmp_path: Path) -> None:
    x1, y1, x2, y2 = opened.mask(0, 2)["box"]
    opened.page.keyboard.press("l")
    opened.drag(0, [[(x1 + x2) / 2, y1 - 20], [(x1 + x2) / 2, y2 + 20]])
    (split,) = opened.save(tmp_path)
    assert split["op"] == "split"
    assert len(split["line"]) >= 2
    hit = opened.page.evaluate(
        "(at) => data.views[0].masks.find((mask) => isOnMask(mask, modes.work.frames[0].toPicture(at))).leaf",
        split["at"],
    )
    assert hit == 2
    opened.page.keyboard.press("l")
    opened.drag(0, [[5, 5], [60, 5]])
    assert opened.num_edits() == 1
    assert "crosses no mask" in opened.page.locator("#correct-note").inner_text()


def test_a_brush_paints_a_leaf_and_an_eraser_takes_from_it(opened: Person, tmp_path: Path) -> None:
    """A stroke is as wide as the brush; what the eraser cuts off goes, for the largest part is the leaf."""
    opened.page.keyboard.press("b")
    opened.drag(0, [[900, 300], [1100, 300], [1300, 300]])
    unit = opened.page.evaluate("modes.work.panes[0].unit")
    radius = opened.page.evaluate("modes.work.radius") * unit
    opened.page.keyboard.press("e")
    opened.page.keyboard.press("[")
    assert opened.page.evaluate("modes.work.radius") * unit < radius
    opened.drag(0, [[1200, 300 - 2 * radius], [1200, 300 + 2 * radius]])
    opened.page.keyboard.press("Enter")
    (edit,) = opened.save(tmp_path)
    assert edit["op"] == "outline"
    points = opened.in_picture(0, edit["polygon"])
    (x1, y1), (x2, y2) = np.min(points, 0), np.max(points, 0)
    assert (x1, y1) == pytest.approx((900 - radius, 300 - radius), abs=6)
    assert y2 == pytest.approx(300 + radius, abs=6)
    assert 1200 - radius < x2 < 1200
    x, y = np.array(points).T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    assert area == pytest.approx(2 * radius * (x2 - 900) + np.pi * radius**2 / 2, rel=0.04)


def test_the_eraser_takes_from_the_mask_that_is_picked(opened: Person, tmp_path: Path) -> None:
    x1, y1, x2, y2 = opened.mask(0, 2)["box"]
    opened.page.keyboard.press("e")
    opened.drag(0, [[x1, y1], [x1, y2]])
    assert "Pick the mask first" in opened.page.locator("#correct-note").inner_text()
    opened.page.keyboard.press("Escape")
    opened.click_mask(0, 2)
    opened.page.keyboard.press("e")
    opened.drag(0, [[x1, y1], [x1, y2]])
    opened.page.get_by_role("button", name="Keep it").click()
    (edit,) = opened.save(tmp_path)
    points = opened.in_picture(0, edit["polygon"])
    assert np.min(points, 0)[0] > x1 + 5
    assert np.max(points, 0)[0] == pytest.approx(x2, abs=6)


def test_masks_in_an_area_are_rejected_at_once_and_struck_out(opened: Person, tmp_path: Path) -> None:
    boxes = [opened.mask(0, leaf)["box"] for leaf in (1, 2)]
    (x1, y1), (x2, y2) = np.min(boxes, 0)[:2] - 5, np.max(boxes, 0)[2:] + 5
    inside = [
        leaf for leaf in (1, 2, 3)
        if x1 < opened.mask(0, leaf)["at"][0] < x2 and y1 < opened.mask(0, leaf)["at"][1] < y2
    ]  # fmt: skip
    corners = [[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]]
    opened.page.keyboard.press("a")
    for corner in corners:
        opened.page.mouse.click(*opened.at(0, [float(value) for value in corner]))
    edits = opened.save(tmp_path)
    assert [edit["op"] for edit in edits] == ["reject"] * len(inside)
    assert len(inside) >= 2
    gone = opened.page.locator(".pane:first-child path.gone")
    assert gone.count() == len(inside)
    opened.click_mask(0, 1)  # the later edit wins
    opened.page.keyboard.press("c")
    assert gone.count() == len(inside) - 1


def test_edits_survive_a_reload_and_can_be_undone(opened: Person, tmp_path: Path) -> None:
    for leaf, key in ((1, "r"), (2, "c"), (3, "r")):
        opened.click_mask(0, leaf)
        opened.page.keyboard.press(key)
    before = opened.save(tmp_path)
    opened.page.reload()
    opened.page.locator("#mode-correct").click()
    assert opened.save(tmp_path) == before
    opened.page.get_by_label("delete edit 2").click()
    assert [edit["op"] for edit in opened.save(tmp_path)] == ["reject", "reject"]
    opened.page.keyboard.press("u")
    assert opened.save(tmp_path) == before
    opened.page.keyboard.press("u")
    assert "nothing to undo" in opened.page.locator("#correct-note").inner_text()


def test_a_file_that_was_saved_is_loaded_as_it_is(opened: Person, bent: Result, tmp_path: Path) -> None:
    edits = [
        {"op": "reject", "view": f"images/{bent.scene.views[0].name}.jpg", "at": [3.25, 4], "by": HOSTILE},
        {"op": "outline", "view": HOSTILE, "polygon": [[1, 2], [3, 4], [5, 9]], "leaf": HOSTILE},
        {"op": "same_track", "at": [["day 1", "0", 1, 2], ["day 2", "0", 1, 2]]},
    ]
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"format": "mvseg-corrections/1", "edits": edits}), encoding="utf-8")
    assert "3 edits loaded" in opened.load(path)
    assert opened.page.locator("#correct-list li .doubt").inner_text() == "this result has no such photo"
    assert HOSTILE in opened.page.locator("#correct-list").inner_text()
    assert "owned" not in opened.page.title()
    with opened.page.expect_download() as download:
        opened.page.get_by_role("button", name="Save corrections.json").click()
    assert json.loads(Path(download.value.path()).read_text(encoding="utf-8"))["edits"] == edits


BROKEN = {
    "{": "no whole JSON file",
    '{"format": "other", "edits": []}': 'expected "format": "mvseg-corrections/1"',
    '{"format": "mvseg-corrections/1", "edits": {}}': "is no list",
    '{"format": "mvseg-corrections/1", "edits": [{"op": "toString"}]}': "edit 1: op is none of",
    '{"format": "mvseg-corrections/1", "edits": [{"op": "reject", "view": "0", "at": [1, null]}]}': "two numbers",
    '{"format": "mvseg-corrections/1", "edits": [' + "0," * 10_000 + "0]}": "expected at most 10000",
}


def test_a_file_that_is_none_is_one_sentence(opened: Person, tmp_path: Path) -> None:
    opened.click_mask(0, 1)
    opened.page.keyboard.press("r")
    path = tmp_path / "broken.json"
    for content, said in BROKEN.items():
        opened.page.evaluate("document.getElementById('correct-note').textContent = ''")
        path.write_text(content, encoding="utf-8")
        assert re.fullmatch(rf"broken\.json: [^\n]*{re.escape(said)}[^\n]*\.", opened.load(path))
        assert opened.num_edits() == 1


def test_the_most_doubtful_is_asked_first_and_answered_by_a_key(
    browser: sync_api.Browser, balls: Result, tmp_path: Path
) -> None:
    scores = balls.masks.match_scores.clone()
    rows = [int(((balls.masks.view_index == 2) & (balls.masks.instance_ids == leaf)).nonzero()[0]) for leaf in (1, 3)]
    scores[rows[0]], scores[rows[1]] = 0.4, 0.2
    doubtful = balls.matching.with_masks(replace(balls.masks, match_scores=scores))
    person = Person(browser, write_page(tmp_path / "report.html", replace(balls, matching=doubtful)))
    person.page.keyboard.press("n")
    name = balls.scene.views[2].name
    assert person.page.locator("#correct-ask p").inner_text().startswith(f"Photo {name}: is this leaf 3?")
    person.page.keyboard.press("s")
    assert person.page.locator("#correct-ask p").inner_text().startswith(f"Photo {name}: is this leaf 1?")
    person.page.keyboard.press("n")  # not now: there is nothing else, so it comes again, if it is asked for
    assert "1 question " in person.page.locator("#correct-ask").inner_text()
    person.page.keyboard.press("n")
    assert "leaf 1?" in person.page.locator("#correct-ask p").inner_text()
    person.page.keyboard.press("r")
    assert person.page.locator("#correct-note").inner_text() == "Nothing doubtful is left."
    same, reject = person.save(tmp_path)
    assert (same["op"], reject["op"]) == ("same", "reject")
    assert same["at"][0][0] == reject["view"] == name
    person.page.keyboard.press("u")
    assert "1 question " in person.page.locator("#correct-ask").inner_text()
    person.close()


def test_no_mask_is_hidden_around_the_plant(browser: sync_api.Browser, balls: Result, tmp_path: Path) -> None:
    """The pictures show one leaf and what is near it; the masks of the others lie around it, matched to none."""
    ids = balls.masks.instance_ids.where(balls.masks.instance_ids == 1, -1)
    masks = replace(balls.masks, instance_ids=ids)
    result = replace(balls, matching=balls.matching.with_masks(masks), instances=Instances())
    person = Person(browser, write_page(tmp_path / "report.html", result))
    caption = person.page.locator("#table-caption").text_content()
    assert caption.endswith(f"{int((ids < 1).sum())} masks matched to no leaf.")
    seen = """() => {
      const { picture, view } = modes.work.panes[0];
      const whole = picture.getBoundingClientRect();
      const shown = [...picture.querySelectorAll("path.mask")].map((path) => path.getBoundingClientRect());
      const isInside = (one) => one.left >= whole.left - 1 && one.right <= whole.right + 1
        && one.top >= whole.top - 1 && one.bottom <= whole.bottom + 1;
      return [data.views[view].box, shown.length, shown.filter(isInside).length];
    }"""
    for view in range(len(balls.scene.views)):
        person.page.evaluate("(view) => modes.work.panes[0].show(view)", view)
        person.page.get_by_role("button", name="whole plant").first.click()
        box, drawn, inside = person.page.evaluate(seen)
        assert box != [0, 0, 1, 1]
        assert drawn == inside == int((masks.view_index == view).sum())
    person.close()


def doubt_all(browser: sync_api.Browser, balls: Result, folder: Path) -> Person:
    doubtful = balls.matching.with_masks(replace(balls.masks, match_scores=torch.full((12,), 0.2)))
    return Person(browser, write_page(folder / "report.html", replace(balls, matching=doubtful)))


def test_an_outline_is_an_answer(browser: sync_api.Browser, balls: Result, tmp_path: Path) -> None:
    """It is drawn in the photo that the question is about, and shows the leaf of the mask that is compared with it; at
    most ten questions are asked."""
    person = doubt_all(browser, balls, tmp_path)
    assert "3 questions " in person.page.locator("#correct-ask").inner_text()
    person.page.keyboard.press("n")
    assert person.page.locator("#correct-ask h2").inner_text() == "Question 1 of 3"
    view, (x, y), other = person.page.evaluate(
        "(() => { const { doubt } = modes.work; return [doubt.view, doubt.mask.at, doubt.otherView]; })()"
    )
    person.page.get_by_role("button", name="Yes, but I draw it").click()
    person.drag(0, [[x - 60, y - 60], [x + 60, y - 60], [x + 60, y + 60], [x - 60, y + 60], [x - 60, y - 50]])
    person.page.keyboard.press("Enter")
    outline, same = person.save(tmp_path)
    names = [each.name for each in balls.scene.views]
    assert (outline["op"], outline["view"]) == ("outline", names[view])
    assert (same["op"], [place[0] for place in same["at"]]) == ("same", [names[view], names[other]])
    assert person.page.locator("#correct-ask p").inner_text().startswith("Photo")  # the next one
    assert person.page.locator("#correct-ask h2").inner_text() == "Question 2 of 3"
    person.page.evaluate("modes.work.numAsked = MOST_ASKED")
    person.page.keyboard.press("n")
    assert "1 question " in person.page.locator("#correct-ask").inner_text()
    note = person.page.locator("#correct-note").inner_text()
    assert note == "These were the questions; those that are left can be asked."
    person.close()


def test_a_leaf_with_half_masks_is_outlined_in_both_photos(
    browser: sync_api.Browser, balls: Result, tmp_path: Path
) -> None:
    person = doubt_all(browser, balls, tmp_path)
    person.page.keyboard.press("n")
    places = person.page.evaluate("""(() => {
      const { doubt } = modes.work;
      doubt.kind = "half";
      return [doubt.mask.at, doubt.otherMask.at];
    })()""")
    person.page.keyboard.press("o")
    for pane, (x, y) in enumerate(places):
        assert person.page.locator("#correct-ask h2").inner_text().startswith("Question 1 of ")
        person.drag(pane, [[x - 60, y - 60], [x + 60, y - 60], [x + 60, y + 60], [x - 60, y + 60], [x - 60, y - 50]])
        person.page.keyboard.press("Enter")
    assert person.page.locator("#correct-ask h2").inner_text().startswith("Question 2 of ")
    first, link, second, back = person.save(tmp_path)
    assert [each["op"] for each in (first, link, second, back)] == ["outline", "same", "outline", "same"]
    one, other = ([place[0] for place in each["at"]] for each in (link, back))
    assert one == other[::-1] == [first["view"], second["view"]]
    person.close()


@pytest.fixture(scope="module")
def offered(balls: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the balls without the third, which is a candidate that was not chosen."""
    is_third = balls.masks.instance_ids == 3
    masks = balls.masks.select(~is_third)
    left = (RejectedCandidate(0.4, balls.masks.select(is_third)),)
    result = replace(balls, matching=balls.matching.with_masks(masks), instances=Instances(), rejected=left)
    return write_page(tmp_path_factory.mktemp("offered") / "report.html", result)


def test_one_key_makes_a_leaf_of_what_was_not_chosen(
    browser: sync_api.Browser, offered: Path, balls: Result, tmp_path: Path
) -> None:
    opened = Person(browser, offered)
    asks = "modes.work.open.filter((doubt) => doubt.isOffered).length"
    assert opened.page.evaluate(asks) == 1
    opened.page.evaluate("modes.work.ask(modes.work.open.find((doubt) => doubt.isOffered))")
    assert "may show a leaf here" in opened.page.locator("#correct-ask").inner_text()
    assert opened.page.locator("svg.work path.proposed").count() == 2
    opened.page.keyboard.press("c")
    edits = opened.save(tmp_path)
    views = balls.masks.view_index[balls.masks.instance_ids == 3].tolist()
    assert {edit["view"] for edit in edits} == {balls.scene.views[view].name for view in views}
    assert len(edits) == len(views) >= 2
    assert {(edit["op"], edit["leaf"]) for edit in edits} == {("outline", "offered 1")}
    assert opened.page.evaluate(asks) == 0
    opened.page.keyboard.press("u")
    assert opened.page.evaluate(asks) == 1
    place = """() => {
      const [, { view, outline }] = modes.work.open.find((doubt) => doubt.isOffered).outlines;
      modes.work.drop();
      modes.work.panes[1].show(view);
      return insidePoint(outline);
    }"""
    opened.page.mouse.click(*opened.at(1, opened.page.evaluate(place)))  # a click where no mask is offers it, too
    assert "may show a leaf here" in opened.page.locator("#correct-ask").inner_text()
    opened.page.keyboard.press("r")
    (edit,) = opened.save(tmp_path)
    assert (edit["op"], edit["everywhere"]) == ("reject", True)
    assert opened.page.evaluate(asks) == 0
    opened.close()


def test_a_guessed_stem_is_asked_about_once(opened: Person, tmp_path: Path) -> None:
    opened.page.evaluate("""() => {
      const line = { name: "stem_1", path: "M900 200L950 900", isGuessed: true };
      for (const view of modes.work.data.views.slice(0, 2)) view.stems = [line, { ...line, leaf: 1 }];
      modes.work.read();
    }""")
    asks = "modes.work.open.filter(({ kind }) => kind === 'stem').length"
    opened.page.keyboard.press("n")
    assert "Is it the stem?" in opened.page.locator("#correct-ask").inner_text()
    assert opened.page.locator("svg.work path.proposed").count() == 2
    opened.page.keyboard.press("r")
    (edit,) = opened.save(tmp_path)
    assert (edit["op"], edit["stem"]) == ("reject", True)
    assert opened.page.evaluate(asks) == opened.page.locator("path.gone").count() == 0
    opened.page.keyboard.press("u")
    assert opened.page.evaluate(asks) == 1


def test_fingers_draw_and_two_of_them_zoom(browser: sync_api.Browser, file: Path) -> None:
    person = Person(browser, file)
    send = """([kind, id, x, y]) => {
      const { picture } = modes.work.panes[0];
      picture.setPointerCapture = () => {};
      const event = { pointerId: id, pointerType: "touch", clientX: x, clientY: y, bubbles: true, button: 0 };
      picture.dispatchEvent(new PointerEvent(kind, event));
    }"""
    x, y = person.at(0, [1000, 700])
    width = "modes.work.panes[0].box.width"
    before = person.page.evaluate(width)
    for event in [("pointerdown", 1, x - 20, y), ("pointerdown", 2, x + 20, y), ("pointermove", 2, x + 40, y),
                  ("pointermove", 1, x - 40, y), ("pointerup", 1, x - 40, y), ("pointerup", 2, x + 40, y)]:  # fmt: skip
        person.page.evaluate(send, list(event))
    assert person.page.evaluate(width) == pytest.approx(before / 2, rel=0.05)
    assert person.page.evaluate("modes.work.picks.length") == 0
    person.page.keyboard.press("o")
    person.page.evaluate(send, ["pointerdown", 1, x, y])
    for turn in range(1, 12):
        person.page.evaluate(send, ["pointermove", 1, x + 60 * np.sin(turn / 2), y + 60 - 60 * np.cos(turn / 2)])
    person.page.evaluate(send, ["pointerup", 1, x, y])
    assert person.page.evaluate("modes.work.draft.isClosed")
    person.close()


def test_nothing_is_wider_than_the_screen(opened: Person) -> None:
    opened.click_mask(0, 1)
    for width in (390, 800, 1280):
        opened.page.set_viewport_size({"width": width, "height": 800})
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
        top = "(name) => document.getElementById(name).getBoundingClientRect().top"
        question, photos = (opened.page.evaluate(top, name) for name in ("correct-ask", "panes"))
        assert (question < photos - 10) == (width < 1000)  # on small screens, the question stands above the photos
