"""Scene folders: which cameras are read, and masks that arrive in the undistorted frame."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from mvseg.errors import InputError, InputWarning
from mvseg.formats.label_png import read_label_png, write_label_png
from mvseg.formats.lens import distort, opencv_lens
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import IGNORE_LABEL, Regions
from scene_folders import HEIGHT, WIDTH, K, edit_rig, write_image, write_scene

DISTORTION = [-0.8, 0.3, 0.01, -0.01, 0.0]


def write_coco_masks(folder: Path, path: Path, num_views: int = 4) -> None:
    """The label PNGs of a scene as COCO, annotation ids counted over all views."""
    images, annotations = [], []
    for view in range(num_views):
        images.append({"id": view, "file_name": f"{view:03d}.png", "width": WIDTH, "height": HEIGHT})
        labels = read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT)
        for number in np.unique(labels)[1:].tolist():
            segmentation = encode_mask(labels == number)
            annotations.append({"id": len(annotations) + 1, "image_id": view, "segmentation": segmentation})
    path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": []}))


def union(regions: Regions, view: int) -> np.ndarray:
    return regions.label_map(view, torch.ones(len(regions), dtype=torch.int64), (WIDTH, HEIGHT)).numpy() > 0


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_cameras_json_goes_first_then_transforms(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    pose = np.eye(4)
    frames = []
    for view in range(2):
        pose[0, 3] = view
        frames.append({"file_path": f"images/{view:03d}.png", "transform_matrix": pose.tolist()})
    intrinsics = {"w": WIDTH, "h": HEIGHT, "fl_x": 99, "cx": 64, "cy": 48}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    scene = load_scene(folder)
    assert (len(scene.views), scene.source, scene.name) == (4, folder / "cameras.json", "plant")
    (folder / "cameras.json").unlink()
    scene = load_scene(str(folder))
    assert (len(scene.views), scene.source) == (2, folder / "transforms.json")


def test_a_link_names_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for plant in ("basil", "mint"):
        write_scene(tmp_path / "days" / plant / "D00")
        (tmp_path / plant).symlink_to(tmp_path / "days" / plant / "D00")
    assert [load_scene(tmp_path / plant).name for plant in ("basil", "mint")] == ["basil", "mint"]
    monkeypatch.chdir(tmp_path / "days" / "mint" / "D00")
    assert [load_scene(path).name for path in (".", "../D00", "../../../mint/")] == ["D00", "D00", "mint"]


def test_binary_masks_are_warned_of(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for path in (folder / "masks").iterdir():
        labels = read_label_png(path, WIDTH, HEIGHT)
        write_label_png(path, np.where(labels > 0, 255, 0))
    with pytest.warns(InputWarning) as caught:
        regions = load_masks(load_scene(folder), folder / "masks")
    assert {warning.filename for warning in caught} == {__file__}  # where the user called, not inside of mvseg
    assert regions.labels.tolist() == [255] * 4


def test_no_folder_and_no_cameras(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent: no such scene folder"):
        load_scene(tmp_path / "absent")
    with pytest.raises(InputError, match=r"no cameras, expected cameras\.json, a COLMAP model in"):
        load_scene(tmp_path)
    (tmp_path / "1.jpg").touch()
    with pytest.raises(InputError, match=r"found 1 photos \(1.jpg, ...\): mvseg pose .* --out SCENE estimates"):
        load_scene(tmp_path)


def test_label_pngs_become_regions(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    labels = read_label_png(folder / "masks" / "001.png", WIDTH, HEIGHT)
    labels[:2, :5] = IGNORE_LABEL
    write_image(folder / "masks" / "001.png", labels)
    regions = load_masks(load_scene(folder), folder / "masks")
    assert regions.num_per_view.tolist() == [3, 3, 3, 3]
    assert regions.labels.tolist() == [1, 2, 3, 11, 12, 13, 21, 22, 23, 31, 32, 33]
    for index, (view, label) in enumerate(zip(regions.view_index.tolist(), regions.labels.tolist(), strict=True)):
        painted = read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT) == label
        np.testing.assert_array_equal(regions.mask(index, WIDTH, HEIGHT), painted)


@pytest.mark.parametrize("kind", ["png", "coco"])
def test_masks_of_distorted_photos_are_undistorted(kind: str, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    straight = load_masks(load_scene(folder), folder / "masks")
    lens = opencv_lens(K, DISTORTION, width=WIDTH, height=HEIGHT)
    for view in range(4):
        edit_rig(folder, view, distortion=DISTORTION)
        path = folder / "masks" / f"{view:03d}.png"
        write_image(path, distort(read_label_png(path, WIDTH, HEIGHT), lens, K))
    masks = folder / "masks"
    if kind == "coco":
        masks = folder / "masks.json"
        write_coco_masks(folder, masks)
    regions = load_masks(load_scene(folder), masks)
    raw = [read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT) > 0 for view in range(4)]
    for view in range(4):
        assert overlap(union(regions, view), union(straight, view)) > 0.95
        assert overlap(union(regions, view), union(straight, view)) > overlap(raw[view], union(straight, view))
    assert min(overlap(raw[view], union(straight, view)) for view in range(4)) < 0.93  # there was something to do
    if kind == "png":
        assert torch.equal(regions.labels, straight.labels)


def test_missing_masks_are_named(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    scene = load_scene(folder)
    (folder / "masks" / "002.png").unlink()
    with pytest.raises(InputError, match=r"masks/002\.png: the mask file is missing \(view 2\)"):
        load_masks(scene, folder / "masks")
    for place in ("absent", "cameras.txt", "absent.json"):
        with pytest.raises(InputError, match=f"{place}: no such masks, expected a folder of label PNGs or a COCO"):
            load_masks(scene, folder / place)


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_of_photos_and_masks_in_the_other_form_of_unicode(form: Literal["NFC", "NFD"], tmp_path: Path) -> None:
    """A zip of a Mac decomposes umlauts; the cameras have them composed, or the other way round."""
    plant = write_scene(tmp_path / "plant", num_views=2)
    other: Literal["NFC", "NFD"] = "NFD" if form == "NFC" else "NFC"
    for view in range(2):
        edit_rig(plant, view, file=f"images/{unicodedata.normalize(form, 'Kübel')}_{view}.png")
        for folder in ("images", "masks"):
            path = plant / folder / f"{view:03d}.png"
            path.rename(path.with_name(f"{unicodedata.normalize(other, 'Kübel')}_{view}.png"))
    scene = load_scene(plant)
    assert [view.path.is_file() for view in scene.views] == [True, True]
    assert load_masks(scene, plant / "masks").num_per_view.tolist() == [3, 3]
