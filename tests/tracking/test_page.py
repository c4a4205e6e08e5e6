"""The page of a plant over days: small, and in a real browser what it says it is."""

from __future__ import annotations

import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from known_leaves import turn_about
from mvseg.corrections.track_links import leaf_at
from mvseg.results.read import load_result
from mvseg.tracking.dates import Number
from mvseg.tracking.growth import measure_growth
from mvseg.tracking.page import describe_tracks, write_page
from mvseg.tracking.pictures import LeafPicture, cut_picture, draw_pictures
from mvseg.tracking.track import TrackRow, Tracks
from report_browser import CHROMIUM, NO_WEBGL, Opened, browser_with, sync_api
from tests.plants_over_days import grow_blades, grown, see, write_result

browser = browser_with(*NO_WEBGL)


def noisy_picture() -> LeafPicture:
    """One that compresses worst."""
    photo, mask = np.random.default_rng(0).integers(0, 256, (90, 90, 3), np.uint8), np.zeros((90, 90), bool)
    mask[5:85, 5:85] = True
    return LeafPicture(cut_picture(photo, mask), "000", (45.5, 45.5))


@pytest.mark.parametrize("orientation", [1, 3])
def test_pictures_follow_the_stored_rows(tmp_path: Path, orientation: int) -> None:
    """Whatever EXIF says: masks and cameras refer to these."""
    write_result(tmp_path / "a", grow_blades(2, 1))
    exif = Image.Exif()
    exif[0x0112] = orientation
    photo = np.zeros((40, 40, 3), np.uint8)
    photo[:, :20, 0], photo[:, 20:, 2] = 255, 255  # leaf 1 is red, leaf 2 is blue
    Image.fromarray(photo).save(tmp_path / "000.png", exif=exif)
    pictures, _ = draw_pictures(load_result(tmp_path / "a"), [1, 2], side=72)
    middles = [np.asarray(Image.open(BytesIO(pictures[leaf].jpeg)))[36, 36] for leaf in (1, 2)]
    assert [int(middle.argmax()) for middle in middles] == [0, 2]
    assert [leaf_at(tmp_path / "a", picture.view, *picture.at) for _, picture in sorted(pictures.items())] == [1, 2]


def many_dates(num_dates: int, num_leaves: int) -> Tracks:
    seen = [see(grown(grow_blades(num_leaves, 1), 1 + 0.02 * day), day) for day in range(num_dates)]
    rows = tuple(
        TrackRow(date=day, track=leaf, state="seen", leaf=1 + truth.index(leaf), probability=0.99)
        for day, (_, truth) in enumerate(seen)
        for leaf in sorted(truth)
    )
    poses, pictures = np.tile(np.eye(4), (num_dates, 1, 1)), dict.fromkeys(range(1, num_leaves + 1), noisy_picture())
    dates = tuple(replace(date, pictures=pictures) for date, _ in seen)
    return Tracks("=<b>basil", dates, rows, poses, (0,) * num_dates, ("a <warning>",))


def test_forty_dates_stay_under_six_megabytes(tmp_path: Path) -> None:
    tracks = many_dates(40, 17)
    write_page(tmp_path, tracks, measure_growth(tracks))
    assert 1e6 < (tmp_path / "tracks.html").stat().st_size < 6e6
    assert "<b>basil" not in (tmp_path / "tracks.html").read_text(encoding="utf-8")


def test_plants_are_shown_in_one_frame_where_they_are_aligned() -> None:
    tracks = many_dates(3, 5)
    moved = see(grow_blades(5, 1), 2, shift=(900, 0, 0))[0]  # not aligned: in a frame of its own
    dates = [replace(date, leaves=tuple(replace(leaf, node_place=leaf.points[0]) for leaf in date.leaves))
             for date in (*tracks.dates[:2], moved)]  # fmt: skip
    apart = Tracks("p", tuple(dates), tracks.rows, tracks.poses, (0, 0, 2), ())
    leaves = describe_tracks(apart, measure_growth(apart))["leaves"]
    assert max(np.abs(leaf["shape"]).max() for leaf in leaves) <= 1000
    assert [leaf["at"] for leaf in leaves] == [leaf["shape"][:3] for leaf in leaves]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")
def test_the_page_in_a_browser(browser: sync_api.Browser, tmp_path: Path) -> None:
    tracks = many_dates(6, 4)
    numbers = {"node_height": Number(30.0, 2.0, "mm"), "node_azimuth": Number(350.0, 5.0, "degree")}
    leaves = [replace(leaf, node=(1, 1), numbers=leaf.numbers | numbers) for leaf in tracks.dates[0].leaves]
    poses = tracks.poses.copy()
    poses[0, :3, :3] = turn_about(np.array([0, 0, 1.0]), 30)
    leaves = [replace(leaf, node_place=np.full(3, 300.0 * n)) for n, leaf in enumerate(leaves)]
    first = replace(tracks.dates[0], leaves=(*leaves[:3], tracks.dates[0].leaves[3]))
    tracks = replace(tracks, dates=(first, *tracks.dates[1:]), poses=poses)
    write_page(tmp_path, tracks, measure_growth(tracks))
    opened = Opened(browser, tmp_path / "tracks.html", (1300, 900), has_space=False)
    shown = opened.page
    assert shown.locator("#plant").inner_text() == "=<b>basil"
    assert shown.locator("#warnings li").inner_text() == "a <warning>"
    assert shown.locator("#dates canvas").count() == 6
    assert shown.locator("#chart polyline").count() == 4
    assert [one.locator("circle").count() for one in shown.locator("#dates .stems").all()] == [3, 0, 0, 0, 0, 0]
    before = shown.evaluate("document.querySelector('canvas').toDataURL()")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp"):
        shown.keyboard.press(key)
    assert shown.locator("#leaf").inner_text() == "Leaf 2"
    assert shown.locator("#crops img").count() == shown.locator("#crops canvas.alone").count() == 6
    assert shown.locator("#chart polygon").count() == 1  # its band
    assert shown.evaluate("document.querySelector('canvas').toDataURL()") != before
    shown.keyboard.press("Escape")
    assert shown.locator("#leaf").inner_text() == "All leaves"
    data = json.loads(shown.locator("#data").text_content() or "")
    assert data["leaves"][0]["node"] == {"azimuth": 20.0, "stem": 1, "node": 1, "height": 30.0, "sd": 2.0}
    leaf = data["leaves"][0]
    shown.locator("tbody tr").nth(leaf["track"] - 1).click()
    assert shown.locator("#leaf").inner_text() == f"Leaf {leaf['track']}"
    opened.close()  # offline, and without a complaint


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed (chromium)")
def test_growth_at_a_glance_on_a_phone(browser: sync_api.Browser, tmp_path: Path) -> None:
    tracks, photo = many_dates(2, 4), noisy_picture().jpeg
    state = {(1, 3): "born", (1, 1): "gone"}
    rows = tuple(
        replace(row, state=state.get((row.date, row.track), "seen"), leaf=None if row.track == 1 else row.leaf)
        if row.date else row
        for row in tracks.rows if (row.date, row.track) != (0, 3)
    )  # fmt: skip
    dates = tuple(replace(date, photo=photo) for date in tracks.dates)
    kept = [{row.leaf for row in rows if row.date == n} for n in (0, 1)]
    dates = tuple(replace(date, leaves=tuple(leaf for leaf in date.leaves if leaf.leaf in of))
                  for date, of in zip(dates, kept, strict=True))  # fmt: skip
    changed = replace(tracks, dates=dates, rows=rows)
    write_page(tmp_path, changed, measure_growth(changed))
    opened = Opened(browser, tmp_path / "tracks.html", (420, 900), has_space=False)
    shown = opened.page
    assert shown.evaluate("document.documentElement.scrollWidth") <= 420
    boxes = [each.bounding_box() for each in shown.locator("#dates canvas").all()]
    assert all(box is not None and box["x"] + box["width"] <= 420 for box in boxes)  # both are seen whole
    assert "3 leaves" in shown.locator("#dates figcaption").nth(1).inner_text()
    assert "1 new · 1 gone" in shown.locator("#dates figcaption").nth(1).inner_text()
    assert "days" in shown.locator("#chart text").all_text_contents()
    assert shown.locator("#chart image").count() == 2
    assert shown.locator("#chart .born").count() == shown.locator("#chart .gone").count() == 1
    from_below = [row.locator("td").first.inner_text() for row in shown.locator("tbody tr").all()]
    assert from_below == ["1", "2", "3", "4"]
    shown.locator("#trait").select_option("relative growth rate")
    assert shown.locator("#chart circle").count() == 1
    opened.close()
