"""Whole folders as cellpose, CVAT and Roboflow write them, where photos and masks lie together."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvseg.errors import InputError, InputWarning
from mvseg.formats.label_png import read_label_png
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import HEIGHT, WIDTH, write_image, write_scene
from warned import warns_of

Write = Callable[[Path, np.ndarray], None]  # the path without suffix, the labels


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "plant")


def labels_of(folder: Path, view: int) -> np.ndarray:
    return read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT)


def write_grey_photo(path: Path, view: int) -> None:
    """Another program's version of a photo: smooth, with every grey value."""
    noise = cv2.GaussianBlur(np.random.default_rng(view).normal(size=(HEIGHT, WIDTH)), (0, 0), 3)
    write_image(path, ((noise - noise.min()) / np.ptp(noise) * 255).astype(np.uint8))


def cellpose(path: Path, labels: np.ndarray) -> None:
    write_image(Path(f"{path}_cp_masks.png"), labels)


def labelme(path: Path, labels: np.ndarray) -> None:
    y, x = np.argwhere(labels)[0].tolist()
    shape = {"label": "leaf", "points": [[x, y], [x + 5, y], [x, y + 5]], "group_id": None, "shape_type": "polygon"}
    content = {"version": "5.5.0", "shapes": [shape], "imagePath": f"{path.name}.png", "imageData": None}
    Path(f"{path}.json").write_text(json.dumps(content))


def yolo(path: Path, _: np.ndarray) -> None:
    Path(f"{path}.txt").write_text("0 0.1 0.1 0.5 0.1 0.5 0.5\n")


SIDE_BY_SIDE: list[tuple[Write, str, int]] = [
    (cellpose, "label images", 12),
    (labelme, "labelme", 4),
    (yolo, "YOLO", 4),
]


@pytest.mark.parametrize(("write", "kind", "num_masks"), SIDE_BY_SIDE)
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_photos_beside_masks_are_no_masks(write: Write, kind: str, num_masks: int, suffix: str, folder: Path) -> None:
    for view in range(4):
        write_grey_photo(folder / "work" / f"{view:03d}{suffix}", view)
        write(folder / "work" / f"{view:03d}", labels_of(folder, view))
    scene = load_scene(folder)
    with warns_of("other_kinds"):
        found = recognise_masks(scene, folder / "work")
    assert found.kind == kind
    with warns_of("other_kinds"):
        assert len(load_masks(scene, folder / "work")) == num_masks


def test_copies_of_the_photos_are_not_looked_at(folder: Path) -> None:
    """Even where they are more than the masks, or lie where an export puts them."""
    shutil.copytree(folder / "images", folder / "work")
    for view in range(3):
        cellpose(folder / "work" / f"{view:03d}", labels_of(folder, view))
    assert recognise_masks(load_scene(folder), folder / "work").kind == "label images"
    shutil.copytree(folder / "images", folder / "export" / "JPEGImages")
    shutil.copytree(folder / "masks", folder / "export" / "SegmentationClass")
    with warns_of("base_names"):
        assert len(load_masks(load_scene(folder), folder / "export")) == 12


@pytest.mark.parametrize(("photos", "masks"), [("images", "masks"), ("JPEGImages", "SegmentationClass")])
def test_two_files_that_fit_one_photo(photos: str, masks: str, folder: Path) -> None:
    for view in range(4):
        write_grey_photo(folder / "export" / photos / f"{view:03d}.png", view)
    shutil.copytree(folder / "masks", folder / "export" / masks)
    scene = load_scene(folder)
    with pytest.raises(InputError, match=rf"export: both {photos}/000.png and {masks}/000.png fit one photo, expected"):
        load_masks(scene, folder / "export")
    assert len(load_masks(scene, folder / "export" / masks)) == 12
    yolo(folder / "export" / "000", labels_of(folder, 0))
    with (
        pytest.warns(InputWarning, match=rf"YOLO for 1 photos are taken, and not label images \(both {photos}/000.png"),
        pytest.warns(InputWarning, match=r"3 photos have no file"),
    ):
        recognise_masks(scene, folder / "export")


def test_a_file_that_is_called_as_the_photo_has_no_rivals(folder: Path) -> None:
    scene = load_scene(folder)
    for view in range(4):
        write_grey_photo(folder / "masks" / "images" / f"{view:03d}.png", view)
        write_grey_photo(folder / "masks" / "drawn" / f"{view:03d}.png", view)
    assert len(load_masks(scene, folder / "masks")) == 12


def test_a_scene_folder_is_no_folder_of_masks(folder: Path) -> None:
    with pytest.raises(InputError, match=r"plant: both masks/000.png and truth/000.png fit one photo, expected"):
        load_masks(load_scene(folder), folder)
    content = {"images": [], "annotations": []}
    (folder / "masks.json").write_text(json.dumps(content))  # one COCO file is clearer than images
    assert recognise_masks(load_scene(folder), folder).files == ((folder / "masks.json",),) * 4


def test_two_suffixes_for_one_photo(folder: Path) -> None:
    write_grey_photo(folder / "masks" / "001.tif", 1)
    with pytest.raises(InputError, match=r"masks: both 001.png and 001.tif fit one photo"):
        load_masks(load_scene(folder), folder / "masks")


def write_roboflow(folder: Path, split: dict[str, tuple[int, ...]]) -> Path:
    """The export as COCO: a folder of photos for each part, every file with ids of its own, from 0."""
    for part, views in split.items():
        images: list[dict[str, Any]] = []
        annotations: list[dict[str, Any]] = []
        for view in views:
            name = f"{view:03d}_png.rf.0f3a{view}.jpg"
            write_grey_photo(folder / "export" / part / name, view)
            images.append({"id": len(images), "license": 1, "file_name": name, "height": HEIGHT, "width": WIDTH})
            for number in np.unique(labels_of(folder, view))[1:]:
                rle = encode_mask(labels_of(folder, view) == number)
                annotation = {"id": len(annotations), "image_id": images[-1]["id"], "category_id": 1, "iscrowd": 0}
                annotations.append(annotation | {"segmentation": rle, "area": 1, "bbox": [0, 0, 1, 1]})
        names = ["leaves", "leaf"] if part == "train" else ["leaf", "leaf"]
        categories = [{"id": number, "name": name, "supercategory": "none"} for number, name in enumerate(names)]
        content = {"info": {}, "categories": categories, "images": images, "annotations": annotations}
        (folder / "export" / part / "_annotations.coco.json").write_text(json.dumps(content))
    (folder / "export" / "README.roboflow.txt").write_text("plants - v1\n")
    return folder / "export"


@pytest.mark.filterwarnings("ignore:.*by the base name only:mvseg.errors.InputWarning")
def test_the_three_parts_of_roboflow(folder: Path) -> None:
    scene = load_scene(folder)
    export = write_roboflow(folder, {"train": (0, 2), "valid": (1,), "test": (3,)})
    expected, found = load_masks(scene, folder / "masks"), load_masks(scene, export, categories=["leaf"])
    assert found.view_index.tolist() == expected.view_index.tolist()
    assert found.areas.tolist() == expected.areas.tolist()
    with pytest.raises(InputError, match=r"export: there is no category 'pot', expected of these: leaf, leaves"):
        load_masks(scene, export, categories=["pot"])
    with warns_of("images_missing"):
        assert len(load_masks(scene, export / "train")) == 6


def test_parts_that_overlap_or_are_of_other_names(folder: Path) -> None:
    scene = load_scene(folder)
    export = write_roboflow(folder, {"train": (0, 2), "valid": (1, 2)})
    with pytest.raises(InputError, match=r"train/_ann\S* and \S*valid/_ann\S* both list 002_png.rf.0f3a2.jpg, exp"):
        load_masks(scene, export)
    (export / "valid" / "_annotations.coco.json").rename(export / "valid" / "old.json")
    message = r"export: holds 2 JSON files \(train/_annotations.coco.json, valid/old.json\), none .* after a photo"
    with pytest.raises(InputError, match=message):
        load_masks(scene, export)
