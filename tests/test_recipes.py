"""The recipes for other programs: the example files are what the script makes, and mvseg reads them."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import recipe_files
from mvseg.cli import main
from mvseg.demo import demo_scene
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_masks, load_scene

ROOT = Path(__file__).parent.parent
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
MASKS = ("sam", "cvat/instances_default.json", "roboflow/_annotations.coco.json")


def test_example_files_are_what_the_script_makes(tmp_path: Path) -> None:
    recipe_files.write_all(tmp_path)
    made, shipped = (
        {path.relative_to(folder).as_posix(): path.read_text() for path in folder.glob("*/**/*.*")}
        for folder in (tmp_path, recipe_files.FOLDER)
    )
    assert made.keys() == shipped.keys()
    for name, text in made.items():
        if name.endswith(".json"):
            assert text == shipped[name]
        else:  # cameras, whose last digits are those of the processor
            numbers, expected = ([float(word) for word in NUMBER.findall(each)] for each in (text, shipped[name]))
            assert numbers == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*MASKS, "metashape", "colmap"])
def test_example_files_are_read(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path, plant = recipe_files.FOLDER / name, demo_scene()
    scene, masks = (plant, path) if name in MASKS else (path, plant / "masks")
    assert main(["check", str(scene), "--masks", str(masks), "--quiet"]) == 0
    assert re.search(r"; (36|108) masks\n", capsys.readouterr().out)  # 12 in each of three or nine photos


def test_of_all_that_sam_finds_the_leaves_are_kept(tmp_path: Path) -> None:
    """By the script's function: without it, background, plant and halves are masks, too."""
    keep_leaves = runpy.run_path(str(ROOT / "docs" / "recipes" / "sam2_masks.py"))["keep_leaves"]
    scene = load_scene(demo_scene())
    for view, (width, height) in zip(scene.views, scene.cameras.sizes.tolist(), strict=True):
        found = recipe_files.sam_entries(read_label_png(demo_scene() / "masks" / f"{view.name}.png", width, height))
        kept = keep_leaves(found, width * height)
        (tmp_path / f"{view.name}.json").write_text(json.dumps(kept))
    given, kept = (load_masks(scene, folder) for folder in (demo_scene() / "masks", tmp_path))
    assert kept.num_per_view.tolist() == given.num_per_view.tolist()
    assert sorted(kept.areas.tolist()) == sorted(given.areas.tolist())


def test_what_cellpose_leaves_beside_the_photos_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its label images; no word of its pickles, which hold the same masks."""
    plant = shutil.copytree(demo_scene(), tmp_path / "plant")
    recipe_files.write_cellpose(plant / "images")
    assert main(["match", str(plant), "--masks", "images", "--out", str(tmp_path / "ids"), "--quiet"]) == 0
    said = capsys.readouterr()
    assert "12 instances from 108 masks (label images) in 9 views" in said.out
    assert said.err == ""
    for path in (plant / "images").glob("*_cp_masks.png"):
        path.unlink()
    assert main(["match", str(plant), "--masks", "images", "--out", str(tmp_path / "ids"), "--quiet"]) == 2
    assert "is a pickle, which may run anything when it is read; in cellpose, save" in capsys.readouterr().err


def test_a_colour_card_undoes_the_light(tmp_path: Path) -> None:
    """Of a card and leaves, drawn flat, in a bluish light; the second time, nothing is overwritten."""
    pcv = pytest.importorskip("plantcv.plantcv", exc_type=ImportError)
    published = np.rint(255 * pcv.transform.std_color_matrix(pos=0)[:, 1:])
    leaves = np.array([(60, 140, 50), (120, 160, 40), (150, 120, 60), (90, 60, 40)])
    light = [0.6, 0.7, 0.8]  # of sRGB values
    card = np.full((800, 1200, 3), 25.0)
    for patch, color in enumerate(published):
        y, x = (60 + 180 * step for step in divmod(patch, 6))
        card[y : y + 144, x : x + 144] = color
    photos = tmp_path / "photos"
    photos.mkdir()
    for path, colors in ((tmp_path / "card.png", card), (photos / "leaves.png", np.tile(leaves, (40, 1, 1)))):
        Image.fromarray(np.rint(colors * light).astype(np.uint8)).save(path)
    correct = runpy.run_path(str(ROOT / "docs" / "recipes" / "color_card.py"))["main"]
    correct(tmp_path / "card.png", photos, tmp_path / "out")
    corrected = np.asarray(Image.open(tmp_path / "out" / "leaves.png")).astype(int)
    assert np.abs(corrected[0] - leaves).max() <= 2
    with pytest.raises(FileExistsError):
        correct(tmp_path / "card.png", photos, tmp_path / "out")
