"""Labels of photos from confirmed masks: what is a leaf, what is background, and what is neither."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvseg.adaptation.labels import FoundLeaves, shrink, write_labels
from mvseg.formats.image_file import read_rgb
from mvseg.formats.label_png import read_labels
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import IGNORE_LABEL
from scene_folders import COLORS, write_scene


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three balls in four views, each of its own colour."""
    return write_scene(tmp_path_factory.mktemp("scenes") / "plant")


def find(plant: Path, confirmed: list[int]) -> FoundLeaves:
    """All balls are found, and those of these numbers confirmed."""
    scene = load_scene(plant)
    regions = load_masks(scene, plant / "truth")
    is_confirmed = torch.isin(regions.labels, torch.tensor(confirmed))
    return FoundLeaves(
        name="plant",
        scene=scene,
        boxes=torch.nn.functional.pad(scene.cameras.sizes, (2, 0)),
        found=regions,
        revised=regions.select(is_confirmed),
        confirmed=torch.ones(int(is_confirmed.sum()), dtype=torch.bool),
        num_kept=int(is_confirmed.sum()),
    )


def test_confirmed_masks_are_labels_and_other_masks_are_ignored(plant: Path, tmp_path: Path) -> None:
    assert write_labels([find(plant, [1, 3])], tmp_path, longest_side=1000) == 4
    for view in range(4):
        labels, truth = (read_labels(path / f"{name}.png") for path, name in (
            (tmp_path / "labels", f"plant-{view:03d}"), (plant / "truth", f"{view:03d}"))
        )  # fmt: skip
        np.testing.assert_array_equal(np.isin(labels, (1, 2)), np.isin(truth, (1, 3)))
        np.testing.assert_array_equal(labels == IGNORE_LABEL, truth == 2)
        photo = read_rgb(tmp_path / "images" / f"plant-{view:03d}.png")
        np.testing.assert_array_equal(photo[truth == 1], np.broadcast_to(COLORS[0], photo[truth == 1].shape))


def test_what_has_the_colour_of_a_leaf_is_no_background(plant: Path, tmp_path: Path) -> None:
    leaves = find(plant, [1])
    is_first = leaves.revised.view_index == 0
    missed = FoundLeaves(
        name="plant",
        scene=leaves.scene,
        boxes=leaves.boxes,
        found=leaves.revised.select(~is_first),
        revised=leaves.revised.select(~is_first),
        confirmed=leaves.confirmed[~is_first],
        num_kept=3,
    )
    twin = FoundLeaves(
        name="twin",
        scene=leaves.scene,
        boxes=leaves.boxes,
        found=leaves.revised,
        revised=leaves.revised,
        confirmed=torch.arange(len(leaves.revised)) == 3,
        num_kept=1,
    )
    assert write_labels([missed, twin], tmp_path, longest_side=1000) == 4  # photos without a label are left out
    assert [path.name for path in sorted((tmp_path / "labels").iterdir())][:3] == [
        "plant-001.png", "plant-002.png", "plant-003.png"
    ]  # fmt: skip
    truth = read_labels(plant / "truth" / "001.png")
    labels = read_labels(tmp_path / "labels" / "plant-001.png")
    assert (labels[truth == 1] == 1).all()
    assert (labels[np.isin(truth, (2, 3))] == 0).all()  # of another colour, and found by nobody


def test_photos_and_labels_are_cut_to_their_boxes(plant: Path, tmp_path: Path) -> None:
    leaves = find(plant, [1, 2, 3])
    write_labels([leaves], tmp_path / "whole", longest_side=1000)
    is_here = leaves.revised.view_index == 1
    x1, y1 = leaves.revised.boxes[is_here, :2].amin(0).tolist()
    x2, y2 = leaves.revised.boxes[is_here, 2:].amax(0).tolist()
    empty = torch.tensor([0, 0, 1, 1])
    boxes = torch.stack((empty, torch.tensor([x1, y1, x2, y2]), empty, empty))
    assert write_labels([replace(leaves, boxes=boxes)], tmp_path / "cut", longest_side=1000) == 1
    for kind, read in (("images", read_rgb), ("labels", read_labels)):
        whole, cut = (read(tmp_path / name / kind / "plant-001.png") for name in ("whole", "cut"))
        np.testing.assert_array_equal(cut, whole[y1:y2, x1:x2])


def test_larger_photos_are_scaled_down_with_their_labels() -> None:
    photo = np.zeros((60, 100, 3), np.uint8)
    labels = np.zeros((60, 100), np.int64)
    photo[10:40, 20:80], labels[10:40, 20:80] = 200, IGNORE_LABEL
    small, small_labels = shrink(photo, labels, 50)
    assert small.shape == (30, 50, 3)
    np.testing.assert_array_equal(small_labels == IGNORE_LABEL, small[..., 0] > 100)
    assert shrink(photo, labels, 100)[0] is photo
