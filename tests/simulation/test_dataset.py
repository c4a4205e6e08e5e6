"""Scenes and data sets on disk: what is written, whole or not at all, resumed, the same for any number of workers."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from pycocotools.coco import COCO

from mvseg.errors import InputError
from mvseg.scene import Cameras
from mvseg.simulation import dataset
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.dataset import EVALUATED_FAMILIES, PRESETS, Preset, list_scenes, write_dataset, write_scene
from mvseg.simulation.growth import FAMILIES, Plant, grow_plant
from mvseg.simulation.ray_cast import render_view

SIZE = 96
TINY = Preset(
    plants=(("train", 1), ("val", 1)),
    leaves=(3, 6),
    views=(2,),
    size=(64, 48),
    families=("ovate", "lobed"),
    has_free_cameras=True,
    has_coco=True,
)


@pytest.fixture(scope="module")
def plant() -> Plant:
    return grow_plant("ovate", 12, seed=2)


@pytest.fixture(scope="module")
def cameras(plant: Plant) -> Cameras:
    return arc_cameras(3, plant, width=SIZE, height=SIZE)


@pytest.fixture(scope="module")
def scene(plant: Plant, cameras: Cameras, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "basil"
    write_scene(folder, plant, cameras, seed=5, min_pixels=20)
    return folder


def read_labels(path: Path) -> Any:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def read_tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# --- scenes


def test_rig_file_gives_the_cameras_back(scene: Path, cameras: Cameras) -> None:
    rig = json.loads((scene / "cameras.json").read_text())
    assert rig["format"] == "mvseg-rig/1"
    assert rig["unit"] == "mm"
    assert [view["file"] for view in rig["views"]] == ["images/000.jpg", "images/001.jpg", "images/002.jpg"]
    for name in ("K", "R", "t"):
        values = torch.tensor([view[name] for view in rig["views"]], dtype=torch.float64)
        assert torch.equal(values, getattr(cameras, name))
    assert all((view["width"], view["height"]) == (SIZE, SIZE) for view in rig["views"])


@pytest.mark.parametrize("view", range(3))
def test_truth_is_the_rendering_without_slivers(scene: Path, plant: Plant, cameras: Cameras, view: int) -> None:
    K, R, t = (x[view].numpy() for x in (cameras.K, cameras.R, cameras.t))
    ids = render_view(plant, K, R, t, SIZE, SIZE, seed=5).ids
    truth = read_labels(scene / "truth" / f"{view:03d}.png")
    assert truth.dtype == np.uint16
    numbers, counts = np.unique(ids, return_counts=True)
    large = numbers[counts >= 20]
    assert np.array_equal(truth, np.where(np.isin(ids, large), ids, 0))


def test_masks_are_a_new_numbering_of_the_truth_in_every_view(scene: Path) -> None:
    numberings = []
    for view in range(3):
        truth, masks = (read_labels(scene / kind / f"{view:03d}.png") for kind in ("truth", "masks"))
        assert masks.dtype == np.uint16
        pairs = np.unique(np.stack([truth.ravel(), masks.ravel()], 1), axis=0)
        assert pairs[0].tolist() == [0, 0]
        num_leaves = len(pairs) - 1
        assert len(np.unique(truth)) == num_leaves + 1
        assert sorted(pairs[1:, 1].tolist()) == list(range(1, num_leaves + 1))
        numberings.append(dict(pairs[1:].tolist()))
    shared = set.intersection(*map(set, numberings))
    assert len(shared) >= 6
    assert len({tuple(numbering[leaf] for leaf in sorted(shared)) for numbering in numberings}) == 3


def test_truth_sizes_and_meshes_are_those_of_the_leaves(scene: Path, plant: Plant) -> None:
    with (scene / "truth" / "traits.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["leaf_id"]) for row in rows] == [leaf.leaf_id for leaf in plant.leaves]
    for row, leaf in zip(rows, plant.leaves, strict=True):
        sizes = [float(row[name]) for name in ("length", "width", "area")]
        assert sizes == pytest.approx([leaf.length, leaf.width, leaf.area], abs=1e-6)
        mesh = trimesh.load_mesh(scene / "truth" / "leaves" / f"leaf_{leaf.leaf_id:03d}.ply", process=False)
        assert mesh.area == pytest.approx(leaf.area, rel=1e-4)
        assert mesh.bounds == pytest.approx(np.stack([leaf.vertices.min(0), leaf.vertices.max(0)]), abs=1e-3)
    assert len(list((scene / "truth" / "leaves").iterdir())) == len(plant.leaves)


def test_photo_is_the_rendering(scene: Path, plant: Plant, cameras: Cameras) -> None:
    K, R, t = (x[0].numpy() for x in (cameras.K, cameras.R, cameras.t))
    rgb = render_view(plant, K, R, t, SIZE, SIZE, seed=5).rgb
    photo = cv2.imread(str(scene / "images" / "000.jpg"))[..., ::-1]
    assert np.abs(photo.astype(int) - rgb).mean() < 8  # JPEG
    assert np.abs(photo[..., ::-1].astype(int) - rgb).mean() > np.abs(photo.astype(int) - rgb).mean()


def test_an_existing_scene_is_not_touched(scene: Path, plant: Plant, cameras: Cameras) -> None:
    before = read_tree(scene)
    with pytest.raises(InputError, match="exists already"):
        write_scene(scene, plant, cameras, seed=0)
    assert read_tree(scene) == before


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, plant: Plant, cameras: Cameras, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(folder: Path, plant: Plant) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset, "write_truth", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "basil", plant, cameras[:1], seed=0)
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_a_killed_process_do_no_harm(tmp_path: Path, plant: Plant, cameras: Cameras) -> None:
    leftover = tmp_path / ".basil.unfinished" / "images" / "999.jpg"
    leftover.parent.mkdir(parents=True)
    leftover.write_bytes(b"half")
    write_scene(tmp_path / "basil", plant, cameras[:1], seed=0)
    assert [path.name for path in tmp_path.iterdir()] == ["basil"]
    assert not (tmp_path / "basil" / "images" / "999.jpg").exists()


# --- data sets


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny")
    write_dataset(TINY, folder, seed=1)
    return folder


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
        truth = read_labels(photo.parents[1] / "truth" / f"{photo.stem}.png")
        assert (image["height"], image["width"]) == truth.shape == cv2.imread(str(photo)).shape[:2]
        found = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]]))
        assert [annotation["instance_id"] for annotation in found] == np.unique(truth[truth > 0]).tolist()
        for annotation in found:
            mask = coco.annToMask(annotation) > 0
            assert np.array_equal(mask, truth == annotation["instance_id"])
            assert annotation["area"] == mask.sum()
            rows, columns = np.nonzero(mask)
            x, y, width, height = annotation["bbox"]
            assert (x, x + width) == (columns.min(), columns.max() + 1)
            assert (y, y + height) == (rows.min(), rows.max() + 1)


def test_list_of_scenes_names_every_folder(tiny: Path) -> None:
    with (tiny / "scenes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    for row in rows:
        assert (tiny / row["folder"] / "cameras.json").exists()
        with (tiny / row["folder"] / "truth" / "traits.csv").open() as file:
            assert len(file.readlines()) == int(row["num_leaves"]) + 1


def test_paper_eval_has_every_cell_in_both_splits() -> None:
    scenes = list_scenes(PRESETS["paper-eval"], seed=0)
    for split, least in (("dev", 3), ("test", 6)):
        for num_leaves in (4, 8, 16, 32):
            for num_views in (3, 5, 10, 20):
                cell = [s for s in scenes if (s.split, s.num_leaves, s.num_views) == (split, num_leaves, num_views)]
                assert len({s.seed for s in cell}) == len(cell) >= least
    assert not {s.seed for s in scenes if s.split == "dev"} & {s.seed for s in scenes if s.split == "test"}
    assert {s.family for s in scenes if s.split == "test"} == set(EVALUATED_FAMILIES)
    plants = {(s.split, s.num_leaves, s.family, s.seed) for s in scenes}
    assert len(plants) == len(scenes) / 4  # one plant for every number of views


def test_train_is_large_and_has_all_families() -> None:
    scenes = [scene for scene in list_scenes(PRESETS["train"], seed=0) if scene.split == "train"]
    assert len({scene.seed for scene in scenes}) >= 200
    assert sum(scene.num_views for scene in scenes) >= 6000
    assert {scene.family for scene in scenes} == set(FAMILIES)
    assert sum(scene.family == "leggy" for scene in scenes) == len(scenes) / 7
    assert len({scene.folder for scene in scenes}) == len(scenes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"num_workers": 0}, "0 workers"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_wrong_wishes_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_dataset(**{"preset": TINY, "folder": tmp_path / "none", **changes})
    assert not (tmp_path / "none").exists()
