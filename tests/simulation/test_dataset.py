"""Data sets: resumed, and the same for any number of workers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from benchmarks.label_maps import plant_index
from csv_rows import read_rows
from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png
from mvseg.simulation import dataset
from mvseg.simulation.dataset import EVALUATED_FAMILIES, PRESETS, Preset, list_specs, write_dataset
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.scene_writer import write_scene
from mvseg.system.atomic import lock_folder

TINY = Preset(
    plants=(("train", 1), ("val", 1)),
    leaves=(3, 6),
    views=(2,),
    size=(64, 48),
    families=("ovate", "lobed"),
    has_free_cameras=True,
    has_coco=True,
)


def read_tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny")
    write_dataset(TINY, folder, seed=1)
    return folder


@pytest.mark.slow
def test_the_number_of_workers_changes_no_byte(tiny: Path, tmp_path: Path) -> None:
    write_dataset(TINY, tmp_path, seed=1, num_workers=2)
    assert read_tree(tmp_path) == read_tree(tiny)


def test_finished_scenes_are_skipped_and_missing_ones_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = replace(TINY, leaves=(3,), views=(1,))
    made: list[str] = []

    def note(folder: Path, *arguments: Any, **options: Any) -> None:
        made.append(folder.name)
        if len(made) == 2:
            raise KeyboardInterrupt
        write_scene(folder, *arguments, **options)

    monkeypatch.setattr(dataset, "write_scene", note)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(small, tmp_path / "resumed", seed=1)
    assert not (tmp_path / "resumed" / "scenes.csv").exists()
    write_dataset(small, tmp_path / "resumed", seed=1)
    assert len(made) == 3  # the first scene was not made again
    monkeypatch.undo()
    write_dataset(small, tmp_path / "whole", seed=1)
    assert read_tree(tmp_path / "resumed") == read_tree(tmp_path / "whole")


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match="holds files that are not a data set"):
        write_dataset(TINY, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_another_recipe_does_not_mix_with_what_is_there(tiny: Path) -> None:
    with pytest.raises(InputError, match="another preset or seed"):
        write_dataset(TINY, tiny, seed=2)
    with pytest.raises(InputError, match="another preset or seed"):
        write_dataset(replace(TINY, views=(3,)), tiny, seed=1)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools with numpy 2
def test_coco_file_agrees_with_the_truth(tiny: Path) -> None:
    coco = COCO(str(tiny / "train.json"))
    assert [category["name"] for category in coco.loadCats(coco.getCatIds())] == ["leaf"]
    images = coco.loadImgs(coco.getImgIds())
    assert len(images) == 4
    for image in images:
        photo = tiny / image["file_name"]
        truth = read_label_png(photo.parents[1] / "truth" / f"{photo.stem}.png", *TINY.size)
        assert (image["height"], image["width"]) == truth.shape == cv2.imread(str(photo)).shape[:2]
        annotations = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]]))
        assert [annotation["instance_id"] for annotation in annotations] == np.unique(truth[truth > 0]).tolist()
        for annotation in annotations:
            mask = coco.annToMask(annotation) > 0
            assert np.array_equal(mask, truth == annotation["instance_id"])
            assert annotation["area"] == mask.sum()
            rows, columns = np.nonzero(mask)
            x, y, width, height = annotation["bbox"]
            assert (x, x + width) == (columns.min(), columns.max() + 1)
            assert (y, y + height) == (rows.min(), rows.max() + 1)


def test_list_of_scenes_names_every_folder(tiny: Path) -> None:
    rows = read_rows(tiny / "scenes.csv")
    assert len(rows) == 4
    for row in rows:
        assert (tiny / row["folder"] / "cameras.json").exists()
        with (tiny / row["folder"] / "truth" / "traits.csv").open() as file:
            assert len(file.readlines()) == int(row["num_leaves"]) + 1


def test_paper_eval_has_every_cell_in_both_splits() -> None:
    scenes = list_specs(PRESETS["paper-eval"], seed=0)
    for split, num_plants in (("dev", 3), ("test", 6)):
        for num_leaves in (4, 8, 16, 32):
            for num_views in (3, 5, 10, 20):
                cell = [s for s in scenes if (s.split, s.num_leaves, s.num_views) == (split, num_leaves, num_views)]
                assert [plant_index(s) for s in cell] == list(range(num_plants))
                assert len({s.seed for s in cell}) == num_plants
    assert not {s.seed for s in scenes if s.split == "dev"} & {s.seed for s in scenes if s.split == "test"}
    assert {s.family for s in scenes if s.split == "test"} == set(EVALUATED_FAMILIES)
    plants = {(s.split, s.num_leaves, s.family, s.seed) for s in scenes}
    assert len(plants) == len(scenes) / 4  # one plant for every number of views


def test_wild_scenes_show_wild_plants(tmp_path: Path) -> None:
    scenes = list_specs(PRESETS["wild"], seed=0)
    assert len(scenes) == 108
    assert {scene.family for scene in scenes if scene.split == "train"} == set(FAMILIES) - {"fern"}
    small = replace(PRESETS["wild"], plants=(("train", 1),), leaves=(2,), views=(2,), size=(48, 48))
    tame = replace(small, is_wild=False)
    write_dataset(small, tmp_path / "wild", seed=5)
    write_dataset(tame, tmp_path / "tame", seed=5)
    photos = [next(folder.glob("train/*/images/000.jpg")).read_bytes() for folder in sorted(tmp_path.iterdir())]
    assert photos[0] != photos[1]
    listed = [json.loads((tmp_path / name / "train.json").read_text())["images"] for name in ("wild", "tame")]
    assert listed[0] == listed[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"num_workers": 0}, "num_workers is 0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_wrong_arguments_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_dataset(**{"preset": TINY, "folder": tmp_path / "none", **changes})
    assert not (tmp_path / "none").exists()


def test_two_runs_on_one_folder_do_not_get_in_each_others_way(tmp_path: Path) -> None:
    with lock_folder(tmp_path), pytest.raises(InputError, match="another run is writing to this folder"):
        write_dataset(TINY, tmp_path)
    assert not list(tmp_path.iterdir())
