"""The page as a file: whole, the same every time, and safe whatever names hold. What it does: test_browser.py."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import torch

from mvseg.results.report.page import ASSETS, SCRIPTS, describe_page, dump_inside_script
from mvseg.results.result import Result
from report_pages import HOSTILE, RUN, draw_pictures, rename_hostile, write_page


class Reader(HTMLParser):
    """The elements of a page, and the texts of its scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.scripts: list[str] = []
        self.title = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.elements[-1:] == ["script"]:
            self.scripts[-1] += data
        elif self.elements[-1:] == ["title"]:
            self.title += data


def read_page(path: Path) -> Reader:
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader


def test_hostile_names_stay_text(balls: Result, tmp_path: Path) -> None:
    plain = read_page(write_page(tmp_path / "plain.html", balls))
    page = read_page(write_page(tmp_path / "hostile.html", rename_hostile(balls)))
    assert page.elements == plain.elements
    assert page.title.strip() == f"plant {HOSTILE} - mvseg"
    data = json.loads(page.scripts[0])
    assert data["plant"] == f"plant {HOSTILE}"
    assert data["views"][2]["name"] == f"2 {HOSTILE}"
    assert data["run"]["findings"][0]["sentence"] == f"found {HOSTILE}"
    assert json.loads(data["run"]["config"]) == RUN["config"]
    assert "files" not in data["run"]


def test_json_inside_a_script_is_still_the_same_json() -> None:
    content = {HOSTILE: ["<!--", "-->", "</SCRIPT", "]]>", "é\u2028\u2029&lt;", Path("a/b")]}
    text = dump_inside_script(content)
    assert not set("<>&\u2028\u2029") & set(text)
    assert json.loads(text) == {HOSTILE: [*content[HOSTILE][:-1], "a/b"]}


def test_nothing_comes_from_elsewhere_and_no_text_becomes_html() -> None:
    own = [(ASSETS / name).read_text(encoding="utf-8") for name in (*SCRIPTS, "page.html", "page.css")]
    for text in own:
        assert re.findall(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|url\(|@import", text) == []
        assert set(re.findall(r"https?://[\w./]+", text)) <= {"http://www.w3.org/2000/svg"}  # a name, never fetched
    assert "default-src 'none'" in own[-2]
    assert sum(file.stat().st_size for file in Path(str(ASSETS)).rglob("*")) < 660_000


def test_the_same_result_gives_the_same_page(balls: Result, tmp_path: Path) -> None:
    first, second = (write_page(tmp_path / name, balls).read_bytes() for name in ("a.html", "b.html"))
    assert first == second
    assert b"\r" not in first
    assert len(first) < 710_000


def test_scores_and_ids_are_those_of_the_result(balls: Result) -> None:
    scores = torch.linspace(0.3, 0.9, len(balls.regions))
    found = replace(balls, matching=balls.matching.with_masks(replace(balls.masks, detection_scores=scores)))
    data = describe_page(found, draw_pictures(found), run=RUN)
    masks = {mask["region"]: (view, mask) for view, entry in enumerate(data["views"]) for mask in entry["masks"]}
    assert sorted(masks) == list(range(len(balls.regions)))
    for region, (view, mask) in masks.items():
        assert view == balls.regions.view_index[region]
        assert mask["leaf"] == balls.matching.instance_ids[region]
        assert abs(mask["match_score"] - float(balls.matching.match_scores[region])) < 1e-4
        assert abs(mask["detection_score"] - (0.3 + 0.6 * region / (len(balls.regions) - 1))) < 1e-4
