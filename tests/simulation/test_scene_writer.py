"""Scenes on disk: what is written, whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from csv_rows import read_rows
from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png
from mvseg.scene import Cameras
from mvseg.simulation import scene_writer
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.scene_writer import MIN_PIXELS, write_scene
from rendered import render_view

SIZE = 96


@pytest.fixture(scope="module")
def plant() -> SimulatedPlant:
    return grow_plant("ovate", 12, seed=2)


@pytest.fixture(scope="module")
def cameras(plant: SimulatedPlant) -> Cameras:
    return arc_cameras(3, plant, width=SIZE, height=SIZE)


@pytest.fixture(scope="module")
def scene(plant: SimulatedPlant, cameras: Cameras, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "basil"
    write_scene(folder, plant, cameras, seed=5)
    return folder


def read_labels(scene: Path, kind: str, view: int) -> np.ndarray:
    return read_label_png(scene / kind / f"{view:03d}.png", SIZE, SIZE)


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
def test_truth_is_the_rendering_without_slivers(
    scene: Path, plant: SimulatedPlant, cameras: Cameras, view: int
) -> None:
    ids = render_view(plant, cameras, view, seed=5).ids
    truth = read_labels(scene, "truth", view)
    numbers, counts = np.unique(ids, return_counts=True)
    large = numbers[counts >= MIN_PIXELS]
    assert np.array_equal(truth, np.where(np.isin(ids, large), ids, 0))


def test_masks_are_a_new_numbering_of_the_truth_in_every_view(scene: Path) -> None:
    numberings = []
    for view in range(3):
        truth, masks = (read_labels(scene, kind, view) for kind in ("truth", "masks"))
        pairs = np.unique(np.stack([truth.ravel(), masks.ravel()], 1), axis=0)
        assert pairs[0].tolist() == [0, 0]
        num_leaves = len(pairs) - 1
        assert len(np.unique(truth)) == num_leaves + 1
        assert sorted(pairs[1:, 1].tolist()) == list(range(1, num_leaves + 1))
        numberings.append(dict(pairs[1:].tolist()))
    shared = set.intersection(*map(set, numberings))
    assert len(shared) >= 6
    assert len({tuple(numbering[leaf] for leaf in sorted(shared)) for numbering in numberings}) == 3


def test_sizes_meshes_and_photo_are_those_of_the_plant(scene: Path, plant: SimulatedPlant, cameras: Cameras) -> None:
    rows = read_rows(scene / "truth" / "traits.csv")
    assert [int(row["leaf_id"]) for row in rows] == [leaf.leaf_id for leaf in plant.leaves]
    for row, leaf in zip(rows, plant.leaves, strict=True):
        sizes = [float(row[name]) for name in ("length", "width", "area")]
        assert sizes == pytest.approx([leaf.length, leaf.width, leaf.area], abs=1e-6)
        mesh = trimesh.load_mesh(scene / "truth" / "leaves" / f"leaf_{leaf.leaf_id:03d}.ply", process=False)
        assert mesh.area == pytest.approx(leaf.area, rel=1e-4)
        assert mesh.bounds == pytest.approx(np.stack([leaf.vertices.min(0), leaf.vertices.max(0)]), abs=1e-3)
    assert len(list((scene / "truth" / "leaves").iterdir())) == len(plant.leaves)
    rgb = render_view(plant, cameras, 0, seed=5).rgb
    photo = cv2.imread(str(scene / "images" / "000.jpg"))[..., ::-1]
    assert np.abs(photo.astype(int) - rgb).mean() < 8  # JPEG
    assert np.abs(photo[..., ::-1].astype(int) - rgb).mean() > np.abs(photo.astype(int) - rgb).mean()


def test_an_existing_scene_is_not_touched(scene: Path, plant: SimulatedPlant, cameras: Cameras) -> None:
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="exists already"):
        write_scene(scene, plant, cameras, seed=0)
    assert {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()} == before


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, plant: SimulatedPlant, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(folder: Path, plant: SimulatedPlant) -> None:
        assert list(tmp_path.iterdir()) != []
        raise KeyboardInterrupt

    monkeypatch.setattr(scene_writer, "write_truth", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "basil", plant, arc_cameras(1, plant, width=16, height=16), seed=0)
    assert list(tmp_path.iterdir()) == []
