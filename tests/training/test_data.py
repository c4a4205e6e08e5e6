"""Samples from label PNGs and COCO files: the same instances from every encoding, and every fault with its file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from mvseg.errors import InputError
from mvseg.training.data import (
    LabelledPhoto,
    Sample,
    check_samples,
    keep_sound,
    list_samples,
    read_sample,
    stack_masks,
)

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # in pycocotools

HEIGHT, WIDTH = 12, 16
SQUARE = np.zeros((HEIGHT, WIDTH), bool)
SQUARE[2:6, 3:9] = True
BAR = np.zeros((HEIGHT, WIDTH), bool)
BAR[4:11, 7:8] = True  # crosses the square


def write_image(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def write_pair(folder: Path, name: str, labels: NDArray[Any] | None, suffix: str = ".png") -> None:
    photo = np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8)  # BGR
    write_image(folder / "photos" / f"{name}{suffix}", photo)
    if labels is not None:
        write_image(folder / "labels" / f"{name}.png", labels)


def read_pair(folder: Path, labels: NDArray[Any]) -> LabelledPhoto:
    write_pair(folder, "a", labels)
    return read_sample(list_samples(folder / "photos", folder / "labels").samples[0])


def masks_of(labelled: LabelledPhoto) -> list[NDArray[Any]]:
    return [(labelled.layers == number + 1).any(0).numpy() for number in range(len(labelled.classes))]


def compressed(mask: NDArray[Any]) -> dict[str, Any]:
    encoded = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": encoded["size"], "counts": encoded["counts"].decode()}


def uncompressed(mask: NDArray[Any]) -> dict[str, Any]:
    flat = mask.flatten(order="F")
    edges = np.flatnonzero(np.diff(flat.astype(int), prepend=0, append=1 - int(flat[-1])))
    return {"size": [HEIGHT, WIDTH], "counts": np.diff(edges, prepend=0).tolist()}


def write_coco(folder: Path, annotations: list[dict[str, Any]], changes: dict[str, Any] | None = None) -> Path:
    write_pair(folder, "a", None)
    content = {
        "images": [{"id": 7, "file_name": "a.png", "height": HEIGHT, "width": WIDTH}],
        "categories": [{"id": 9, "name": "stem"}, {"id": 4, "name": "leaf"}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 4} | annotation for annotation in annotations],
    }
    path = folder / "instances.json"
    path.write_text(json.dumps(content | (changes or {})))
    return path


def read_coco(
    folder: Path, annotations: list[dict[str, Any]], changes: dict[str, Any] | None = None
) -> LabelledPhoto:
    return read_sample(list_samples(folder / "photos", write_coco(folder, annotations, changes)).samples[0])


# --- label maps


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_label_map(tmp_path: Path, dtype: Any) -> None:
    labels = np.zeros((HEIGHT, WIDTH), dtype)
    labels[SQUARE], labels[BAR] = 200, 3
    labelled = read_pair(tmp_path, labels)
    assert (labelled.photo.dtype, labelled.photo[:, 0, 0].tolist()) == (torch.uint8, [30, 20, 10])
    assert labelled.classes.tolist() == [1, 1]
    for ours, expected in zip(masks_of(labelled), (BAR, SQUARE & ~BAR), strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert not labelled.ignore.any()


def test_ignored_pixels_and_a_map_without_background(tmp_path: Path) -> None:
    labels = np.where(SQUARE, 65535, 5).astype(np.uint16)
    labels[0] = 2
    labelled = read_pair(tmp_path, labels)
    np.testing.assert_array_equal(labelled.ignore.numpy(), SQUARE)
    np.testing.assert_array_equal(masks_of(labelled), [labels == 2, labels == 5])
    full = read_pair(tmp_path, np.full((HEIGHT, WIDTH), 4, np.uint16))
    assert masks_of(full)[0].all()


def test_an_empty_photo_is_a_sample(tmp_path: Path) -> None:
    labelled = read_pair(tmp_path, np.zeros((HEIGHT, WIDTH), np.uint8))
    assert (len(labelled.classes), labelled.layers.shape) == (0, (1, HEIGHT, WIDTH))
    assert not labelled.layers.any()


def test_photos_are_found_in_subfolders_and_sorted(tmp_path: Path) -> None:
    for name, suffix in (("b", ".jpg"), ("scene/a", ".PNG"), ("c", ".tif")):
        write_pair(tmp_path, name, np.zeros((HEIGHT, WIDTH), np.uint8), suffix)
    (tmp_path / "photos" / "notes.txt").write_text("no photo")
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    assert [sample.name for sample in found.samples] == ["b.jpg", "c.tif", "scene/a.PNG"]
    assert found.categories == ("leaf",)
    assert check_samples(found.samples) == ([0, 0, 0], {})


# --- COCO


def test_every_encoding_gives_the_same_instance(tmp_path: Path) -> None:
    polygon = [[3.0, 2.0, 9.0, 2.0, 9.0, 6.0, 3.0, 6.0]]
    halves = [[3, 2, 6, 2, 6, 6, 3, 6], [6, 2, 9, 2, 9, 6, 6, 6]]
    for segments in (compressed(SQUARE), uncompressed(SQUARE), polygon, halves):
        labelled = read_coco(tmp_path, [{"segmentation": segments}])
        np.testing.assert_array_equal(masks_of(labelled)[0], SQUARE)


def test_overlaps_classes_and_crowds(tmp_path: Path) -> None:
    crowd = np.zeros_like(SQUARE)
    crowd[10:] = True
    labelled = read_coco(
        tmp_path,
        [
            {"segmentation": compressed(SQUARE)},
            {"segmentation": uncompressed(crowd), "iscrowd": 1},
            {"segmentation": compressed(BAR), "category_id": 9},
        ],
    )
    assert labelled.classes.tolist() == [1, 2]  # by category id: leaf 4, stem 9
    np.testing.assert_array_equal(masks_of(labelled), [SQUARE, BAR])
    assert len(labelled.layers) == 2
    np.testing.assert_array_equal(labelled.ignore.numpy(), crowd)


def test_instances_share_layers_where_they_can() -> None:
    corner = np.zeros_like(SQUARE)
    corner[0, 0] = True
    layers = stack_masks([SQUARE, BAR, corner], (HEIGHT, WIDTH))
    assert [sorted(set(layer.flatten().tolist())) for layer in layers] == [[0, 1, 3], [0, 2]]


def test_an_image_without_annotations_is_a_sample(tmp_path: Path) -> None:
    found = list_samples(tmp_path / "photos", write_coco(tmp_path, []))
    assert found.categories == ("leaf", "stem")
    assert check_samples(found.samples) == ([0], {})


# --- faults


@pytest.mark.parametrize(
    ("annotation", "message"),
    [
        ({}, "a.png: annotation 1 has no readable segmentation"),
        ({"segmentation": "leaf"}, "annotation 1 has no readable segmentation"),
        ({"segmentation": [[1, 2, 3]]}, "annotation 1 has no readable segmentation"),
        ({"segmentation": []}, "annotation 1 "),
        ({"segmentation": compressed(SQUARE[:6])}, "annotation 1 is 16 x 6 pixels, the photo 16 x 12"),
        ({"segmentation": compressed(SQUARE & False)}, "annotation 1 covers no pixel"),
        ({"segmentation": compressed(SQUARE), "category_id": 5}, "unknown category 5"),
    ],
)
def test_broken_annotations(tmp_path: Path, annotation: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_coco(tmp_path, [annotation])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": [{"id": 7, "file_name": "a.png", "height": 5, "width": 5}]}, "its COCO entry says 5 x 5"),
        ({"images": [{"id": 7, "file_name": "b.png", "height": 5, "width": 5}]}, r"b.png: the photo .* is missing"),
        ({"images": [{"id": 8, "file_name": "a.png", "height": 5, "width": 5}]}, "annotations of image 7"),
        ({"images": [], "annotations": []}, "lists 0 images"),
        ({"categories": []}, "0 categories"),
        ({"annotations": 3}, "is not a COCO file of instances"),
    ],
)
def test_broken_coco_files(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_coco(tmp_path, [{"segmentation": compressed(SQUARE)}], changes)


def test_broken_label_maps(tmp_path: Path) -> None:
    """Every broken sample is found in one go, with its own sentence."""
    sound = np.where(SQUARE, 1, 0).astype(np.uint16)
    write_pair(tmp_path, "a_sound", sound)
    write_pair(tmp_path, "b_no_mask", None)
    write_pair(tmp_path, "c_size", sound[:5])
    write_pair(tmp_path, "d_colour", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_pair(tmp_path, "e_float", sound)
    (tmp_path / "labels" / "e_float.png").write_bytes(b"torn")
    write_pair(tmp_path, "f_photo", sound)
    (tmp_path / "photos" / "f_photo.png").write_bytes(b"")
    write_image(tmp_path / "labels" / "g_no_photo.png", sound)
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    counts, broken = check_samples(found.samples)
    assert counts == [1, 0, 0, 0, 0, 0, 0]
    expected = (
        "b_no_mask.png: its label map .* is missing",
        "c_size.png: its label map is 16 x 5 pixels, the photo 16 x 12",
        "d_colour.png: .* is not a single-channel PNG",
        "e_float.png: .* is not a single-channel PNG",
        "f_photo.png: the photo cannot be read",
        "g_no_photo.*: the photo .* is missing",
    )
    assert len(broken) == len(expected)
    for sentence, pattern in zip(broken.values(), expected, strict=True):
        with pytest.raises(InputError, match=pattern):
            raise InputError(sentence)
    with pytest.raises(InputError, match=r"6 of 7 training samples are broken \(b_no_mask.png: .*; \.\.\.\)"):
        keep_sound(found, "training", skip_broken=False)
    kept, left_out = keep_sound(found, "training", skip_broken=True)
    assert [sample.name for sample in kept.samples] == ["a_sound.png"]
    assert left_out == broken


def test_folders_that_hold_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="is not a folder"):
        list_samples(tmp_path / "none", tmp_path)
    with pytest.raises(InputError, match="holds no photo"):
        list_samples(tmp_path / "empty", tmp_path / "empty")
    with pytest.raises(InputError, match="neither a folder of label PNGs nor a COCO"):
        list_samples(tmp_path, tmp_path / "labels.txt")
    write_pair(tmp_path, "a", np.zeros((HEIGHT, WIDTH), np.uint8))
    empty = list_samples(tmp_path / "photos", tmp_path / "labels")
    with pytest.raises(InputError, match="none of the 1 validation samples holds an instance"):
        keep_sound(empty, "validation", skip_broken=True)
    write_pair(tmp_path, "a", None, ".jpg")
    with pytest.raises(InputError, match="would share one label PNG"):
        list_samples(tmp_path / "photos", tmp_path / "labels")


# --- real plants


@pytest.mark.shared_data
def test_real_rosettes_are_sound_and_the_same_from_coco(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "rosettes-cvppp-a1"
    found = list_samples(folder / "images", folder / "labels")
    counts, broken = check_samples(found.samples)
    assert (len(found), broken) == (100, {})
    assert min(counts) >= 10
    labelled = read_sample(found.samples[0])
    height, width = labelled.ignore.shape
    annotations = [
        {"id": number, "image_id": 1, "category_id": 1, "segmentation": compressed(mask)}
        for number, mask in enumerate(masks_of(labelled))
    ]
    content = {
        "images": [{"id": 1, "file_name": found.samples[0].name, "height": height, "width": width}],
        "categories": [{"id": 1, "name": "leaf"}],
        "annotations": annotations,
    }
    (tmp_path / "coco.json").write_text(json.dumps(content))
    from_coco: Sample = list_samples(folder / "images", tmp_path / "coco.json").samples[0]
    assert torch.equal(read_sample(from_coco).layers, labelled.layers)
    assert torch.equal(read_sample(from_coco).photo, labelled.photo)
