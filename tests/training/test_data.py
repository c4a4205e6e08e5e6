"""Samples from label PNGs and COCO files: the same instances from every encoding, and every fault with its file."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from pycocotools import mask as coco_mask

from mvseg.errors import InputError, InputWarning
from mvseg.evaluation.labelled_photo import LabelledPhoto
from mvseg.training.data import check_samples, keep_sound, list_samples, read_sample
from warned import warns_of

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # in pycocotools

HEIGHT, WIDTH = 12, 16
SQUARE = np.zeros((HEIGHT, WIDTH), bool)
SQUARE[2:6, 3:9] = True
BAR = np.zeros((HEIGHT, WIDTH), bool)
BAR[4:11, 7:8] = True  # crosses the square
IMAGE = {"id": 7, "file_name": "a.png", "height": HEIGHT, "width": WIDTH}


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
        "images": [IMAGE],
        "categories": [{"id": 9, "name": "stem"}, {"id": 4, "name": "leaf"}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 4} | annotation for annotation in annotations],
    }
    path = folder / "instances.json"
    path.write_text(json.dumps(content | (changes or {})))
    return path


def read_coco(folder: Path, annotations: list[dict[str, Any]], changes: dict[str, Any] | None = None) -> LabelledPhoto:
    return read_sample(list_samples(folder / "photos", write_coco(folder, annotations, changes)).samples[0])


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


def test_ignored_pixels_a_map_without_background_and_an_empty_photo(tmp_path: Path) -> None:
    labels = np.where(SQUARE, 65535, 5).astype(np.uint16)
    labels[0] = 2
    labelled = read_pair(tmp_path, labels)
    np.testing.assert_array_equal(labelled.ignore.numpy(), SQUARE)
    np.testing.assert_array_equal(masks_of(labelled), [labels == 2, labels == 5])
    full = read_pair(tmp_path, np.full((HEIGHT, WIDTH), 4, np.uint16))
    assert masks_of(full)[0].all()
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


def test_overlaps_classes_and_crowds(tmp_path: Path) -> None:
    crowd = np.zeros_like(SQUARE)
    crowd[10:] = True
    path = write_coco(
        tmp_path,
        [
            {"segmentation": compressed(SQUARE)},
            {"segmentation": uncompressed(crowd), "iscrowd": 1},
            {"segmentation": compressed(BAR), "category_id": 9},
        ],
    )
    with warns_of("crowds_ignored"):
        labelled = read_sample(list_samples(tmp_path / "photos", path, crowd="ignore").samples[0])
    assert labelled.classes.tolist() == [1, 2]  # by category id: leaf 4, stem 9
    np.testing.assert_array_equal(masks_of(labelled), [SQUARE, BAR])
    assert len(labelled.layers) == 2
    np.testing.assert_array_equal(labelled.ignore.numpy(), crowd & ~SQUARE & ~BAR)
    with warns_of("crowds_taken"):  # as a run takes them
        labelled = read_sample(list_samples(tmp_path / "photos", path).samples[0])
    np.testing.assert_array_equal(masks_of(labelled), [SQUARE, crowd, BAR])


def test_coco_is_read_as_for_a_scene(tmp_path: Path) -> None:
    """Ids as text, names of another program, an image without a size; and what stands twice or reads as nothing."""
    image = IMAGE | {"id": "7", "file_name": "images/5f1c0e7a-A.png", "height": 0, "width": 0}
    square = {"segmentation": compressed(SQUARE), "category_id": "4"}
    with warns_of("base_names"):
        labelled = read_coco(tmp_path, [square], {"images": [image]})
    np.testing.assert_array_equal(masks_of(labelled), [SQUARE])
    with pytest.raises(InputError, match=r"images 7 \(a.png\) and 8 \(a.png\) are of one photo"):
        read_coco(tmp_path, [square, square | {"image_id": 8}], {"images": [IMAGE, IMAGE | {"id": 8}]})
    with pytest.raises(InputError, match=r"instances.json: all corners lie between 0 and 1"):
        read_coco(tmp_path, [{"segmentation": [[0.1, 0.2, 0.9, 0.2, 0.5, 0.9]]}])


def test_masks_of_other_kinds_are_read_as_for_a_scene(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", None)
    (tmp_path / "labels").mkdir()
    square = "0 0.1875 0.16666 0.5625 0.16666 0.5625 0.5 0.1875 0.5"
    (tmp_path / "labels" / "a.txt").write_text(f"{square}\n0 0.5 0.5 0.1 0.1\n")
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    np.testing.assert_array_equal(masks_of(read_sample(found.samples[0])), [SQUARE])
    with warns_of("boxes_left_out"):
        assert check_samples(found.samples) == ([1], {})
    (tmp_path / "labels" / "a.txt").unlink()
    np.save(tmp_path / "labels" / "a.npy", np.stack([SQUARE, BAR]))
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    np.testing.assert_array_equal(masks_of(read_sample(found.samples[0])), [SQUARE, BAR])


def test_labels_that_read_as_something_else(tmp_path: Path) -> None:
    labels = np.kron(np.arange(30).reshape(5, 6) * 11 % 31 * 8, np.ones((21, 21))).astype(np.uint8)
    write_image(tmp_path / "photos" / "a.png", np.zeros((*labels.shape, 3), np.uint8))
    write_image(tmp_path / "labels" / "a.png", cv2.resize(labels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_LINEAR))
    with pytest.raises(InputError, match=r"its photo is 126 x 105"):
        read_sample(list_samples(tmp_path / "photos", tmp_path / "labels").samples[0])
    small = cv2.resize(labels, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_LINEAR)
    write_image(tmp_path / "labels" / "a.png", small)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGB", small.shape[::-1]).save(tmp_path / "photos" / "a.png", exif=exif)
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    with (
        pytest.warns(InputWarning, match=r"a.png: EXIF turns 1 photos for display"),
        pytest.raises(InputError, match=r"training samples: numbers lie along the edges of others"),
    ):
        keep_sound(found, "training", skip_broken=True)
    write_image(tmp_path / "labels" / "a.png", np.ones_like(small))
    with warns_of("background_masks"):
        check_samples(found.samples)


def test_an_image_without_annotations_is_a_sample(tmp_path: Path) -> None:
    found = list_samples(tmp_path / "photos", write_coco(tmp_path, []))
    assert found.categories == ("leaf", "stem")
    assert check_samples(found.samples) == ([0], {})


@pytest.mark.parametrize(
    ("annotation", "message"),
    [
        ({"segmentation": "leaf"}, "its segmentation is neither polygons"),
        ({"segmentation": compressed(SQUARE), "category_id": 5}, "its category 5 is not listed"),
        ({"segmentation": compressed(SQUARE), "category_id": [4]}, r"its category \[4\] is not listed"),
    ],
)
def test_broken_annotations(tmp_path: Path, annotation: dict[str, Any], message: str) -> None:
    """Each is found with its sample, and is no reason to stop before the others are looked at."""
    found = list_samples(tmp_path / "photos", write_coco(tmp_path, [annotation]))
    ((_, problem),) = check_samples(found.samples)[1].items()
    assert re.match(f"a.png: annotation 1: .*{message}", problem)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": [IMAGE | {"height": 5, "width": 5}]}, "its COCO entry says 5 x 5"),
        ({"images": [IMAGE | {"file_name": "b.png"}]}, r"b.png: the photo .*b.png cannot be read, .*: No such file"),
        ({"images": [IMAGE | {"id": 8}]}, "annotations of image 7"),
        ({"images": [], "annotations": []}, "lists 0 images"),
        ({"categories": []}, "0 categories"),
        ({"images": [IMAGE | {"file_name": "../b.png"}]}, "image ../b.png: the file name leads out of the folder"),
        ({"categories": [{"id": 4}]}, r"categories\[0\].name: Field required"),
        ({"annotations": 3}, "annotations: Input should be a valid list"),
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
    write_pair(tmp_path, "d_colour", np.zeros((HEIGHT, WIDTH, 3), np.uint8))  # sound: a colour would be an instance
    write_pair(tmp_path, "e_torn", sound)
    (tmp_path / "labels" / "e_torn.png").write_bytes(b"torn")
    write_pair(tmp_path, "f_photo", sound)
    (tmp_path / "photos" / "f_photo.png").write_bytes(b"")
    write_image(tmp_path / "labels" / "g_no_photo.png", sound)
    found = list_samples(tmp_path / "photos", tmp_path / "labels")
    counts, broken = check_samples(found.samples)
    assert counts == [1, 0, 0, 0, 0, 0, 0]
    expected = (
        "b_no_mask.png: .*b_no_mask.png: the mask file is missing",
        "c_size.png: .*c_size.png: the mask is 16 x 5, its photo is 16 x 12",
        "e_torn.png: .* cannot be read, expected a whole label PNG",
        "f_photo.png: the photo .*f_photo.png cannot be read, expected a whole image file",
        "g_no_photo.*: the photo .* cannot be read, .*: No such file",
    )
    assert len(broken) == len(expected)
    for sentence, pattern in zip(broken.values(), expected, strict=True):
        assert re.match(pattern, sentence)
    with pytest.raises(InputError, match=r"5 of 7 training samples are broken \(b_no_mask.png: .*; \.\.\.\)"):
        keep_sound(found, "training", skip_broken=False)
    kept, left_out = keep_sound(found, "training", skip_broken=True)
    assert [sample.name for sample in kept.samples] == ["a_sound.png", "d_colour.png"]
    assert left_out == broken


@pytest.mark.parametrize("kind", ["labelme", "COCO"])
def test_photos_that_nobody_has_labelled_yet(kind: str, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_image(tmp_path / "photos" / f"{name}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    corners = [[2.0, 2.0], [9.0, 2.0], [9.0, 8.0]]
    shapes = [{"label": "leaf", "points": corners, "shape_type": "polygon"}]
    images = [{"id": n, "file_name": f"{n}.png", "width": WIDTH, "height": HEIGHT} for n in "abc"]
    drawn = [{"id": 1, "image_id": "a", "category_id": 1, "segmentation": [[2.0, 2.0, 9.0, 2.0, 9.0, 8.0]]}]
    (tmp_path / "labels").mkdir()
    labels = tmp_path / "labels" / ("a.json" if kind == "labelme" else "all.json")
    labels.write_text(json.dumps(
        {"shapes": shapes, "imagePath": "a.png", "imageHeight": HEIGHT, "imageWidth": WIDTH} if kind == "labelme"
        else {"images": images, "annotations": drawn, "categories": [{"id": 1, "name": "leaf"}]}
    ))  # fmt: skip
    with warnings.catch_warnings(action="ignore"):  # labelme: of photos without a file
        found = list_samples(tmp_path / "photos", tmp_path / "labels" if kind == "labelme" else labels)
    with warns_of("photos_without_labels"):
        kept, _ = keep_sound(found, "training", skip_broken=False)
    assert len(kept) == 3
    kept, _ = keep_sound(found, "training", skip_broken=False, skip_unlabelled=True)
    assert [sample.name for sample in kept.samples] == ["a.png"]


def test_folders_that_hold_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="is not a folder"):
        list_samples(tmp_path / "none", tmp_path)
    with pytest.raises(InputError, match="holds no photo"):
        list_samples(tmp_path / "empty", tmp_path / "empty")
    write_pair(tmp_path, "a", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match=r"labels.txt: no such masks, expected a folder of label PNGs or a COCO"):
        list_samples(tmp_path, tmp_path / "labels.txt")
    empty = list_samples(tmp_path / "photos", tmp_path / "labels")
    with pytest.raises(InputError, match="none of the 1 validation samples holds an instance"):
        keep_sound(empty, "validation", skip_broken=True)
    write_pair(tmp_path, "a", None, ".jpg")
    with pytest.raises(InputError, match="would share one label image"):
        list_samples(tmp_path / "photos", tmp_path / "labels")
