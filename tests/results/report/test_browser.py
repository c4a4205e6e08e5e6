"""What a person does with the page, in a real browser. Skipped where no chromium is installed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csv_rows import read_rows
from mvseg.results.result import Instances, Result
from report_browser import CHROMIUM, OPTIONS, Opened, browser_with, sync_api
from report_pages import HOSTILE, rename_hostile, write_page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")]


browser = browser_with(*OPTIONS)


@pytest.fixture(scope="module")
def files(balls: Result, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    ids = replace(balls, instances=Instances())
    kinds = {"hostile": rename_hostile(balls), "ids": ids}
    return {kind: write_page(folder / f"{kind}.html", result) for kind, result in kinds.items()}


class Viewer(Opened):
    """What a person sees and does."""

    def selected(self) -> dict[str, list[int]]:
        """The leaves that are lit up: in the table, in the photos, in 3D and in the panel."""
        return self.page.evaluate(
            """() => {
              const numbers = (found) => [...new Set(found)].sort();
              const all = (query) => [...document.querySelectorAll(query)];
              const leafIn = (text) => Number(text.match(/Leaf (\\d+)/)?.[1] ?? 0);
              return {
                table: numbers(all("#table tr.selected").map((row) => Number(row.dataset.leaf))),
                photos: numbers(all("#tiles path.selected").map((path) => Number(path.dataset.leaf))),
                space: numbers(page.litLeaves()),
                panel: numbers(all("#leaf h2").map((title) => leafIn(title.textContent))),
              };
            }"""
        )

    def click_in_space(self, leaf: int) -> None:
        box = self.page.locator("#canvas").bounding_box()
        at = self.page.evaluate("(leaf) => page.positionOf(leaf)", leaf)
        self.page.mouse.click(box["x"] + at["x"], box["y"] + at["y"])

    def click_on_mask(self, leaf: int) -> None:
        at = self.page.evaluate(
            """(leaf) => {
              const path = document.querySelector(`#tiles path[data-leaf="${leaf}"]`);
              path.scrollIntoView({ block: "center" });
              const { x, y, width, height } = path.getBoundingClientRect();
              return [x + width / 2, y + height / 2];
            }""",
            leaf,
        )
        self.page.mouse.click(*at)


@pytest.fixture
def opened(browser: sync_api.Browser, files: dict[str, Path]) -> Iterator[Viewer]:
    opened = Viewer(browser, files["hostile"], (1280, 800))
    yield opened
    opened.close()


def everywhere(leaf: int) -> dict[str, list[int]]:
    return {"table": [leaf], "photos": [leaf], "space": [leaf], "panel": [leaf]}


def test_the_picture_in_3d_can_be_printed(opened: Viewer) -> None:
    """It stays in its canvas, in its own proportions, and numbers are placed in parts of it, none on another."""
    count = """() => {
      const canvas = document.getElementById("canvas"), copy = document.createElement("canvas");
      [copy.width, copy.height] = [canvas.width, canvas.height];
      const brush = copy.getContext("2d");
      brush.drawImage(canvas, 0, 0);
      const { data } = brush.getImageData(0, 0, copy.width, copy.height);
      return data.filter((value, n) => n % 4 === 3 && value > 0).length;
    }"""
    opened.page.wait_for_timeout(300)  # then a canvas that keeps nothing is empty
    assert opened.page.evaluate(count) > 500
    assert opened.page.locator("#space-labels span").first.evaluate("(each) => each.style.left").endswith("%")
    box = "document.getElementById('canvas').getBoundingClientRect()"
    ratio = f"() => {box}.width / {box}.height"
    shown = opened.page.evaluate(ratio)
    opened.page.emulate_media(media="print")
    printed = opened.page.evaluate(ratio)
    opened.page.emulate_media(media="screen")
    assert printed == pytest.approx(shown, rel=0.05)
    opened.page.evaluate("for (const label of page.labels) label.at = page.labels[0].at; page.placeLabels()")
    spots = opened.page.evaluate("page.labels.slice(0, 3).map(({ spot }) => spot)")
    assert min(np.linalg.norm(np.subtract(spots[n], spots[n - 1])) for n in range(3)) > 10


def test_a_click_anywhere_selects_the_leaf_everywhere(opened: Viewer) -> None:
    nothing = {"table": [], "photos": [], "space": [], "panel": [0]}
    assert opened.selected() == nothing
    for leaf in (1, 2, 3):
        opened.click_in_space(leaf)
        assert opened.selected() == everywhere(leaf)
        opened.page.keyboard.press("Escape")
        opened.page.locator("#plant").hover()  # the pointer lights a leaf up, too
        assert opened.selected() == nothing
        opened.click_on_mask(leaf)
        assert opened.selected() == everywhere(leaf)
        opened.page.locator("#leaf h2 button").click()
        opened.page.locator(f"#table tr[data-leaf='{leaf}'] td").nth(1).click()
        assert opened.selected() == everywhere(leaf)
        opened.page.keyboard.press("Escape")


def test_the_pointer_lights_a_leaf_up_everywhere(opened: Viewer) -> None:
    opened.page.locator("#table tr[data-leaf='2'] td").nth(2).hover()
    lit = "document.querySelectorAll('#tiles path.hovered').length"
    assert opened.page.evaluate(lit) == 4
    assert opened.page.evaluate("page.litLeaves()") == [2]
    assert opened.page.locator("#tip").inner_text().startswith("Leaf 2, volume ")
    opened.page.locator("#plant").hover()
    assert opened.page.evaluate(lit) == 0
    assert opened.page.evaluate("page.litLeaves()") == []


def test_leaves_are_drawn_in_their_colours(opened: Viewer) -> None:
    """The pixel of the screen where a leaf is has the hue of its swatch, and a selected leaf lets the others fade."""
    look = """(leaf) => new Promise((done) => {
      page.drawNow();
      const { x, y } = page.positionOf(leaf);
      const canvas = document.getElementById("canvas");
      const copy = document.createElement("canvas");
      [copy.width, copy.height] = [canvas.width, canvas.height];
      const brush = copy.getContext("2d");
      brush.drawImage(canvas, 0, 0);
      done([...brush.getImageData(Math.round(x), Math.round(y), 1, 1).data]);
    })"""
    for leaf in (1, 2, 3):
        red, green, blue, alpha = opened.page.evaluate(look, leaf)
        color = opened.page.evaluate("(leaf) => data.leaves[leaf - 1].color", leaf)
        wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
        assert alpha == 255
        assert [red, green, blue].index(max(red, green, blue)) == wanted.index(max(wanted))
    opened.page.evaluate("selection.select(1)")
    assert opened.page.evaluate(look, 2)[3] < 200 < opened.page.evaluate(look, 1)[3]


def test_headers_sort_and_sort_back(opened: Viewer, balls: Result) -> None:
    assert balls.traits is not None
    volumes = {leaf.leaf: leaf.numbers["volume"].value for leaf in balls.traits.leaves}
    header = opened.page.locator("#table th", has_text="volume")
    order = "[...document.querySelectorAll('#table tbody tr')].map((row) => Number(row.dataset.leaf))"
    header.locator("button").click()
    assert opened.page.evaluate(order) == sorted(volumes, key=lambda leaf: volumes[leaf])
    assert header.get_attribute("aria-sort") == "ascending"
    header.locator("button").click()
    assert opened.page.evaluate(order) == sorted(volumes, key=lambda leaf: -volumes[leaf])
    assert header.get_attribute("aria-sort") == "descending"
    assert opened.page.locator("#table th[aria-sort]").count() == 1


def test_columns_are_chosen_and_saved_as_csv(opened: Viewer, balls: Result) -> None:
    assert balls.traits is not None
    header = opened.page.locator("#table th", has_text="x min")
    assert (header.is_visible(), opened.page.locator("#table th", has_text="pieces").is_visible()) == (False, True)
    opened.page.locator("#table-columns summary").click()
    opened.page.get_by_label("x min", exact=True).check()
    opened.page.get_by_label("pieces", exact=True).uncheck()
    assert (header.is_visible(), opened.page.locator("#table th", has_text="pieces").is_visible()) == (True, False)
    opened.page.locator("#table th", has_text="leaf").first.locator("button").click()  # the last one first
    with opened.page.expect_download() as download:
        opened.page.locator("#save-table").click()
    rows = read_rows(Path(download.value.path()))
    assert {"num_pieces", "x_max"}.isdisjoint(rows[0])
    assert [row["leaf"] for row in rows] == ["3", "2", "1"]
    assert {(row["plant"], row["unit"]) for row in rows} == {(f"plant {HOSTILE}", f"mm {HOSTILE}")}
    assert {row["quality"] for row in rows} == {f"doubt {HOSTILE}"}
    for row, leaf in zip(reversed(rows), balls.traits.leaves, strict=True):
        for name in ("volume", "x_min", "num_views"):
            assert float(row[name]) == pytest.approx(leaf.numbers[name].value, rel=1e-5)
    written = opened.page.evaluate("[writeCell('=1+2'), writeCell(-1.5), writeCell('a, b'), writeCell(null)]")
    assert written == ["'=1+2", "-1.5", '"a, b"', ""]


def test_keys_go_through_the_table(opened: Viewer) -> None:
    opened.page.locator("#table tbody button").first.focus()
    opened.page.keyboard.press("Enter")
    assert opened.selected() == everywhere(1)
    opened.page.keyboard.press("ArrowDown")
    opened.page.keyboard.press("ArrowDown")
    opened.page.keyboard.press("ArrowDown")  # there is no fourth
    assert opened.selected() == everywhere(3)
    opened.page.keyboard.press("ArrowUp")
    assert opened.selected() == everywhere(2)


def test_hostile_names_are_read_as_text(opened: Viewer) -> None:
    assert opened.page.title() == f"plant {HOSTILE} - mvseg"
    assert opened.page.locator("#plant").inner_text() == f"plant {HOSTILE}"
    assert opened.page.locator("#tiles figcaption span").nth(2).inner_text() == f"2 {HOSTILE}"
    assert opened.page.locator("#findings li").inner_text() == f"error, photos: found {HOSTILE}"
    opened.page.evaluate("selection.select(1)")
    assert opened.page.locator("#leaf .doubt li").inner_text() == f"doubt {HOSTILE}"
    assert opened.page.locator("#leaf .crops button").count() == 4
    (walk,) = opened.page.locator("img").all()
    assert walk.get_attribute("alt") == "cameras round the plant"


def test_a_direction_that_is_rounded_to_a_full_turn_is_0(opened: Viewer) -> None:
    numbers = [(359.8, 12, "\u00b0"), (359.8, 1.2, "\u00b0"), (-0.2, 12, "\u00b0"), (359.8, 12, "mm")]
    written = opened.page.evaluate("(all) => all.map((each) => formatNumber(...each).value)", numbers)
    assert written == ["0", "359.8", "0", "360"]


def test_photos_and_cameras_know_each_other(opened: Viewer) -> None:
    opened.page.locator("#tiles figcaption button", has_text="3D").nth(1).click()
    place, center = opened.page.evaluate("[page.camera.position.toArray(), data.space.cameras[1].center]")
    assert place == pytest.approx(center, abs=1e-3)
    for leaf in (1, 2, 3):  # the leaf in 3D lies over its mask in the photo
        seen, mask, canvas, tall = opened.page.evaluate(
            """(leaf) => [
              page.positionOf(leaf), data.views[1].masks.find((mask) => mask.leaf === leaf),
              [canvas.clientWidth, canvas.clientHeight], 2000 * data.views[1].proportion,
            ]""",
            leaf,
        )
        scale = min(canvas[0] / 2000, canvas[1] / tall)  # the whole picture fits
        x, y = ((seen[axis] - side / 2) / scale for axis, side in zip("xy", canvas, strict=True))
        x1, y1, x2, y2 = mask["box"]
        assert x1 < x + 1000 < x2
        assert y1 < y + tall / 2 < y2
    opened.click_in_space(2)  # which does not turn the view away
    assert opened.selected() == everywhere(2)
    assert opened.page.locator("#space-note").inner_text().startswith(f"From the camera of photo 1 {HOSTILE}")
    opened.page.locator("#look-plant").click()
    assert opened.page.locator("#space-note").inner_text().startswith("Squares on the ground: 5 mm")
    opened.page.evaluate("shownView.show(2)")
    assert opened.page.locator("#tiles figure.lit").get_attribute("data-view") == "2"
    opened.page.evaluate("selection.select(2)")
    opened.page.locator("#only-showing").check()
    assert opened.page.locator("#tiles figure:visible").count() == 4


def test_ids_alone_have_a_page_without_leaves_in_3d(browser: sync_api.Browser, files: dict[str, Path]) -> None:
    opened = Viewer(browser, files["ids"], (1280, 800))
    assert opened.page.locator("#space-note").inner_text().startswith("Cameras only")
    opened.click_on_mask(2)
    assert opened.selected() == everywhere(2) | {"space": []}
    assert opened.page.locator("#table th").all_inner_texts() == ["leaf", "views", "match score"]
    opened.close()


def test_nothing_is_wider_than_the_screen(opened: Viewer) -> None:
    opened.page.evaluate("selection.select(1)")
    for width in (390, 800, 1280):
        opened.page.set_viewport_size({"width": width, "height": 800})
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
