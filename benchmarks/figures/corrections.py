"""Draws the pictures of docs/corrections.md: `python benchmarks/figures/corrections.py --folder DIR`

The shipped plant gets masks with a segmenter's faults; a person, driven by playwright, opens the page of the result in
chromium. A result that is in DIR is not made again.
"""

from __future__ import annotations

import argparse
import io
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.faults import Faults, degrade_labels
from mvseg.cli import main as run
from mvseg.demo import demo_scene
from mvseg.formats.label_png import read_labels, write_label_png

DOCS = Path(__file__).parents[2] / "docs"
SEED = 5
PAIR, LINKED = (2, 5), 6  # photos, and the leaf that is clicked at in both
WIDTH, HEIGHT = 1180, 700
OPTIONS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


def write_faulty(folder: Path) -> None:
    """The shipped plant, with the faults of a segmenter in its masks."""
    shutil.copytree(demo_scene(), folder)
    for view, path in enumerate(sorted((folder / "masks").glob("*.png"))):
        write_label_png(path, degrade_labels(read_labels(path), Faults(), seed=100 * SEED + view))


def shoot(page: Page, name: str) -> None:
    """A picture of the page as a small JPEG."""
    picture = Image.open(io.BytesIO(page.screenshot()))
    picture.convert("RGB").save(DOCS / f"correcting-{name}.jpg", quality=72, optimize=True)


class Person:
    """What a person does with a page in the mode "Correct"."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def at(self, pane: int, xy: list[float]) -> tuple[float, float]:
        """Where the screen shows a point of a photo."""
        code = """([pane, [x, y]]) => {
          const at = new DOMPoint(x, y).matrixTransform(modes.work.panes[pane].picture.getScreenCTM());
          return [at.x, at.y];
        }"""
        x, y = self.page.evaluate(code, [pane, xy])
        return x, y

    def show(self, pane: int, view: int) -> None:
        self.page.evaluate("([pane, view]) => modes.work.panes[pane].show(view)", [pane, view])

    def mask(self, view: int, leaf: int) -> Any:
        find = "([view, leaf]) => data.views[view].masks.find((mask) => mask.leaf === leaf)"
        return self.page.evaluate(find, [view, leaf])

    def missed_leaf(self, scene: Path, view: int) -> list[list[float]]:
        """The outline of the largest leaf that no mask shows, as a hand draws it."""
        truth = read_labels(scene / "truth" / f"{view:03d}.png")
        masks = read_labels(scene / "masks" / f"{view:03d}.png")
        missed = [leaf for leaf in np.unique(truth[truth > 0]) if (masks[truth == leaf] > 0).mean() < 0.3]
        shown = truth == max(missed, key=lambda leaf: int((truth == leaf).sum()))
        lines, _ = cv2.findContours(shown.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outline = max(lines, key=len)[:, 0] + 0.5
        x1, y1, x2, _ = self.page.evaluate("(view) => data.views[view].box", view)
        corner, scale = np.array([x1 * shown.shape[1], y1 * shown.shape[0]]), 2000 / ((x2 - x1) * shown.shape[1])
        drawn: list[list[float]] = ((outline[::4] - corner) * scale).tolist()
        return [*drawn, drawn[0]]

    def draw(self, pane: int, line: list[list[float]]) -> None:
        self.page.mouse.move(*self.at(pane, line[0]))
        self.page.mouse.down()
        for point in line[1:]:
            self.page.mouse.move(*self.at(pane, point), steps=2)
        self.page.mouse.up()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    folder = parser.parse_args().folder
    scene, result = folder / "plant", folder / "result"
    if not scene.exists():
        write_faulty(scene)
    if not result.exists():
        run(["infer", str(scene), "--masks", "masks", "--out", str(result)])
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto((result / "report.html").as_uri())
        page.locator("#mode-correct").click()
        person = Person(page)
        page.keyboard.press("n")
        while page.evaluate("modes.work.doubt.kind") != "missing":  # the text is about such a question
            page.keyboard.press("n")
        shoot(page, "ask")
        page.keyboard.press("c")
        for pane, view in enumerate(PAIR):
            person.show(pane, view)
            page.mouse.click(*person.at(pane, person.mask(view, LINKED)["at"]))
        shoot(page, "pick")
        page.keyboard.press("s")
        person.show(1, PAIR[1])
        page.keyboard.press("o")
        person.draw(1, person.missed_leaf(scene, PAIR[1]))
        shoot(page, "draw")
        browser.close()


if __name__ == "__main__":
    main()
