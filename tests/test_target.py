"""`mvseg target` and `mvseg check --target`: the page, and photos of it by known cameras."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mvseg.cli import main
from mvseg.demo import demo_scene
from mvseg.formats.markers import find_markers, read_grey
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.target import FAMILY, TAG, list_shapes, tag_corners
from mvseg.pipeline.run_scene import run_scene
from mvseg.results.result import Result
from mvseg.runs import check_target
from photographed_page import HEIGHT, MIDDLE, WIDTH, aim_cameras, write_photos


def photograph(folder: Path, num_views: int) -> Path:
    """Photos of the page, printed at 97 %, with the true cameras and a lens."""
    cameras = aim_cameras(num_views, size=(960, 720), focal=750.0, seed=4)
    write_photos(folder, cameras, px_per_mm=4, seed=4, printed=0.97, lens=(0.03, -0.01))
    return folder


@pytest.fixture(scope="module")
def two_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photograph(tmp_path_factory.mktemp("target") / "page", 2)


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("mvseg: error: ")


def test_shapes_have_the_areas_of_the_formulas_and_touch_nothing_else() -> None:
    """A bent leaf has that of a straight one: what a half gains outside of the arc, the other loses inside (Pappus)."""
    disc, *leaves = list_shapes()
    assert disc.area == pytest.approx(np.pi * 35**2, rel=2e-5)
    u = np.linspace(0, 1, 100_001)
    formulas = ((72, 54, 0.6, 0.9), (72, 24, 0.8, 1.0), (76, 30, 0.7, 0.9))
    for leaf, (length, width, base, tip) in zip(leaves, formulas, strict=True):
        half = u**base * (1 - u) ** tip
        assert leaf.area == pytest.approx(length * width * (half / half.max()).mean(), rel=1e-4)
    boxes = [(shape.cell[0], shape.cell[2]) for shape in list_shapes()]
    boxes += [(corners[0] - TAG / 8, corners[2] + TAG / 8) for corners in tag_corners().values()]  # with a white module
    for index, (low, high) in enumerate(boxes):
        assert (low >= 5).all()  # mm, what printers leave white
        assert (high <= (WIDTH - 5, HEIGHT - 5)).all()
        for other_low, other_high in boxes[:index]:
            assert ((low >= other_high) | (high <= other_low)).any()


def test_the_page_is_in_millimetres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "page.pdf"
    assert main(["target", str(path)]) == 0
    assert "mvseg pose needs --distance marker:0 marker:11 277.48 --unit mm" in capsys.readouterr().out
    pdf = path.read_text(encoding="ascii")
    k = 72 / 25.4  # points per millimetre
    media = re.findall(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    np.testing.assert_allclose(np.array(media, float), [[210 * k, 297 * k]])
    matrix = re.search(r"stream\n([-\d.]+) 0 0 ([-\d.]+) 0 ([-\d.]+) cm", pdf)
    assert matrix is not None
    np.testing.assert_allclose(np.array(matrix.groups(), float), [k, -k, 297 * k], rtol=1e-7)
    assert ", ".join(f"{shape.name} {shape.area:.1f} mm2" for shape in list_shapes()) in pdf
    for number, corners in tag_corners().items():  # the black module at its top left
        (x, y), module = corners[0], TAG / 8
        assert f"{x:g} {y:g} m\n{x + module:g} {y:g} l\n{x + module:g} {y + module:g} l\n" in pdf, number
    # every object is where the table of the PDF says
    start = int(pdf.split("startxref\n")[1].split()[0])
    assert pdf[start:].startswith("xref\n0 5\n")
    for number, offset in enumerate(re.findall(r"(\d{10}) 00000 n", pdf), start=1):
        assert pdf[int(offset) :].startswith(f"{number} 0 obj\n")


def test_another_suffix_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["target", str(tmp_path / "page.png")]) == 2
    assert complaint(capsys) == f"{tmp_path / 'page.png'}: expected a name that ends with .pdf"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("light", [(1.0, 0.9, 0.7), (0.5, 0.6, 0.7)])
@pytest.mark.parametrize(("shade", "most_wrong"), [(1.0, 0), (0.4, 100)])
def test_masks_end_where_half_of_the_light_is_ink(
    light: tuple[float, float, float], shade: float, most_wrong: int
) -> None:
    """A disc whose edge mixes light over two pixels, in lamplight and in blue shade, and partly in a hard shadow."""
    rows, columns = np.mgrid[:200, :200] + 0.5
    share = np.clip((60 - np.hypot(rows - 100, columns - 97)) / 2 + 0.5, 0, 1)[..., None]
    strength = np.where(rows > 120, shade, 1.0)[..., None]
    mixed = (share * (0.65, 0.04, 0.2) + (1 - share) * 0.95) * strength * light
    photo = np.round(255 * mixed ** (1 / 2.2)).astype(np.uint8)
    turn = np.linspace(0, 2 * np.pi, 100)
    outline = np.stack([97 + 55 * np.cos(turn), 104 + 55 * np.sin(turn)], 1)  # a bit beside and smaller: no matter
    cell = np.array([[10.0, 10], [190, 10], [190, 190], [10, 190]])
    labels = check_target.cut_shapes(photo, {7: (cell, outline)})
    assert np.unique(labels).tolist() == [0, 7]
    assert ((labels == 7) != (share[..., 0] > 0.5)).sum() <= most_wrong  # of 11,304 pixels
    assert not check_target.cut_shapes(photo, {7: (cell, outline + 100)}).any()  # another thing than the shape


@pytest.mark.slow
def test_a_page_printed_at_97_percent_is_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Law: measured with the bar as printed, the areas are right."""
    results: list[Result] = []

    def run_once(*args: Any, **options: Any) -> Result:
        results.append(results[0] if results else run_scene(*args, **options))
        return results[0]

    monkeypatch.setattr(check_target, "run_scene", run_once)
    photos, out = photograph(tmp_path / "page", 6), tmp_path / "out"
    assert main(["check", str(photos), "--target", "--quiet", "--out", str(out)]) == 1
    assert "lengths are 3.0% too short: the page was not printed at 100 %" in capsys.readouterr().out
    wrong = json.loads((out / "target.json").read_text())
    assert wrong["scale"] == pytest.approx(0.97, abs=0.002)
    assert wrong["is_right"] is False

    assert main(["check", str(photos), "--target", "--bar", "97", "--quiet", "--out", str(out)]) == 0
    said, right = capsys.readouterr().out, json.loads((out / "target.json").read_text())
    assert "4 of 4 within their intervals" in said or "3 of 4 within their intervals" in said
    assert right["num_tags"] == 12
    assert right["residual"] < 0.5  # mm
    assert right["scale"] == pytest.approx(1, abs=0.002)
    assert [shape["name"] for shape in right["shapes"]] == [shape.name for shape in list_shapes()]
    for shape, before in zip(right["shapes"], wrong["shapes"], strict=True):
        assert abs(shape["error"]) < 0.015
        assert 0 < shape["sd"] < 0.05 * shape["true_area"]
        assert shape["area"] == before["area"]
        assert shape["true_area"] == pytest.approx(0.97**2 * before["true_area"])
        assert shape["num_views"] == shape["num_masks"] >= 4


def test_a_photo_without_shapes_is_named(two_photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Printed without colour: its tags are found, its shapes are not."""
    folder = Path(shutil.copytree(two_photos, tmp_path / "page"))
    path = folder / "images" / "01.jpg"
    grey = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2GRAY)
    cv2.imwrite(str(path), grey)
    assert main(["check", str(folder), "--target", "--quiet"]) == 2
    expected = "none of the page's shapes is found, expected one whole, printed in colour; leave the photo out"
    assert complaint(capsys) == f"{path}: view 1: {expected}"


def test_photos_of_something_else_and_cameras_without_a_unit(
    capsys: pytest.CaptureFixture[str], two_photos: Path, tmp_path: Path
) -> None:
    assert main(["check", str(demo_scene()), "--target", "--quiet"]) == 2
    said = "no tag of the page is found in the photos, expected photos of the page that mvseg target writes"
    assert complaint(capsys) == f"{demo_scene() / 'cameras.json'}: {said}"
    rig = json.loads((two_photos / "cameras.json").read_text())
    (tmp_path / "cameras.json").write_text(json.dumps(rig | {"unit": ""}))
    (tmp_path / "images").symlink_to(two_photos / "images")
    assert main(["check", str(tmp_path), "--target", "--quiet"]) == 2
    said = "they say no unit, expected mm, cm or m, as mvseg pose --unit mm states it"
    assert complaint(capsys) == f"{tmp_path / 'cameras.json'}: {said}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--bar", "97"], "--bar is of the page of mvseg target, expected --target with it"),
        (["--target", "--bar", "-1"], "--bar is -1, expected its length in mm, about 100"),
        (["--target", "--masks", "masks"], "--masks and --categories have no effect with --target: its shapes are"),
    ],
)
def test_options_that_do_not_fit(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(demo_scene()), *words, "--quiet"]) == 2
    assert complaint(capsys).startswith(message)


def test_tags_are_where_the_page_says(two_photos: Path) -> None:
    """Corners in the order of `find_markers`, no half pixel off."""
    scene = load_scene(two_photos)
    found = find_markers(read_grey(Photos(scene), 0), FAMILY)
    assert found.keys() <= tag_corners().keys()
    misses = []
    for number, quad in found.items():
        world = MIDDLE + 0.97 * (tag_corners()[number] - MIDDLE)
        px, _ = scene.cameras[[0]].project(torch.from_numpy(np.pad(world, ((0, 0), (0, 1)))))
        misses.append(quad - px[0].numpy())
    assert np.abs(np.mean(misses, axis=(0, 1))).max() < 0.1
    assert np.abs(misses).max() < 1.5
