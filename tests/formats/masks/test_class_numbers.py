"""Label images whose numbers mean classes, and photos in their place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvseg.errors import InputError, InputWarning
from mvseg.formats.label_png import write_label_png
from mvseg.formats.masks.class_numbers import has_components_apart
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import HEIGHT, WIDTH, write_image, write_scene

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
    with pytest.warns(InputWarning, match=r"masks: the number 15 has parts far apart in 4 of 4 photos.*Segmentation"):
        assert len(load_masks(load_scene(folder), folder / "masks")) == 8


def test_pieces_in_few_photos_are_no_classes(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for name in ("000.png", "001.png"):
        write_label_png(folder / "masks" / name, CLASSES)
    assert len(load_masks(load_scene(folder), folder / "masks")) == 10  # warnings are errors


def test_a_photo_is_no_label_image(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    write_image(folder / "masks" / "002.png", noise)
    with pytest.raises(InputError, match=r"masks: the label image of view 2 holds 25\d numbers .* is it a photo\?"):
        load_masks(load_scene(folder), folder / "masks")


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
