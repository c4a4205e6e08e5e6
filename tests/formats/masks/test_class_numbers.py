"""Label images whose numbers mean classes, and photos in their place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.formats.label_png import write_label_png
from mvseg.formats.masks.class_numbers import count_between, has_components_apart
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import IGNORE_LABEL
from scene_folders import HEIGHT, WIDTH, write_image, write_scene
from warned import warns_of

CLASSES = np.zeros((HEIGHT, WIDTH), np.uint16)
CLASSES[10:30, 10:30] = CLASSES[10:30, 90:110] = 15  # two leaves
CLASSES[60:90, 40:80] = 3  # the pot


@pytest.mark.parametrize("kind", ["PNG", "npy"])
def test_a_number_per_class_is_warned_of(kind: str, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for path in sorted((folder / "masks").iterdir()):
        write_label_png(path, CLASSES)
        if kind == "npy":
            np.save(path.with_suffix(".npy"), CLASSES)
            path.unlink()
    with warns_of("class_numbers"):
        assert len(load_masks(load_scene(folder), folder / "masks")) == 8


def test_pieces_in_few_photos_are_no_classes_and_a_photo_no_label_image(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for name in ("000.png", "001.png"):
        write_label_png(folder / "masks" / name, CLASSES)
    assert len(load_masks(load_scene(folder), folder / "masks")) == 10  # warnings are errors
    folder = write_scene(tmp_path / "other")
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    write_image(folder / "masks" / "002.png", noise)
    with pytest.raises(InputError, match=r"masks: the label image of view 2 holds 25\d numbers .* is it a photo\?"):
        load_masks(load_scene(folder), folder / "masks")


@pytest.mark.parametrize("scale", [0.5, 2.0])
@pytest.mark.parametrize("interpolation", [cv2.INTER_LINEAR, cv2.INTER_CUBIC])
def test_label_images_that_were_scaled_with_interpolation(scale: float, interpolation: int, tmp_path: Path) -> None:
    """Whether new numbers appear, or only those of other leaves; to the nearest pixel, nothing is said."""
    folder = write_scene(tmp_path / "plant")
    scene = load_scene(folder)
    size = (round(scale * WIDTH), round(scale * HEIGHT))
    sizes = torch.tensor([size] * len(scene.views))
    scene = replace(scene, cameras=replace(scene.cameras, sizes=sizes))
    paths = sorted((folder / "masks").iterdir())
    images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]
    for method in (cv2.INTER_NEAREST, interpolation):
        for path, image in zip(paths, images, strict=True):
            write_label_png(path, cv2.resize(image, size, interpolation=method))
        if method == cv2.INTER_NEAREST:
            assert load_masks(scene, folder / "masks").num_per_view.tolist() == [3] * 4
    with pytest.raises(InputError, match=r"masks: numbers lie along the edges .* scaled with interpolation\? scale"):
        load_masks(scene, folder / "masks")


def test_pixels_between_are_counted_as_one_by_one() -> None:
    labels = np.random.default_rng(0).integers(0, 4, (60, 40)).astype(np.uint16)
    labels[:, :7], labels[5, 9] = 0, IGNORE_LABEL
    counts = np.zeros(2, np.int64)
    for row, column in np.ndindex(labels.shape):
        near = labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        near = np.where(near == IGNORE_LABEL, 0, near)
        own = 0 if labels[row, column] == IGNORE_LABEL else labels[row, column]
        counts += [near.min() != near.max(), near.min() < own < near.max()]
    np.testing.assert_array_equal(count_between(labels), counts)


def pieces(*boxes: tuple[int, int, int, int], scale: int = 1) -> np.ndarray:
    mask = np.zeros((100, 200), bool)
    for x1, y1, x2, y2 in boxes:
        mask[y1:y2, x1:x2] = True
    return np.kron(mask, np.ones((scale, scale), bool))


@pytest.mark.parametrize("scale", [1, 7])
def test_pieces_that_lie_apart(scale: int) -> None:
    assert has_components_apart(pieces((0, 0, 40, 40), (160, 0, 200, 40), scale=scale))
    assert not has_components_apart(pieces((0, 0, 40, 40), (46, 0, 86, 40), scale=scale))  # a stem in front
    assert not has_components_apart(pieces((0, 0, 40, 40), (190, 0, 200, 10), scale=scale))  # a crumb
    assert not has_components_apart(pieces((0, 0, 200, 3), scale=scale))
    assert not has_components_apart(np.ones((1, 1), bool))
