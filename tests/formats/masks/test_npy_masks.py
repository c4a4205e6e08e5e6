"""NumPy files: arrays come back, and nothing in a file is ever run."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.masks.npy_masks import read_npy
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import write_scene

LABELS = (np.arange(40 * 60).reshape(40, 60) // 100).astype(np.uint16)


class Hostile:
    """Unpickled by pickle itself, it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = str(folder)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("dtype", ["u1", "<i4", ">u2", "f8", "u8"])
def test_labels_of_any_type(dtype: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", LABELS.astype(dtype))
    found = read_npy(tmp_path / "a.npy", 60, 40)
    assert isinstance(found, np.ndarray)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, LABELS)


@pytest.mark.parametrize("dtype", ["?", "u1", "u2", "u4", "u8", "i1", "<i2", ">i4", "i8", "f2", "f4", ">f8"])
def test_stacks_of_any_type_may_overlap(dtype: str, tmp_path: Path) -> None:
    masks = np.random.default_rng(0).random((3, 40, 60)) > 0.4
    np.save(tmp_path / "a.npy", masks.astype(dtype) * np.array(255 if dtype == "u1" else 1, dtype))
    found = read_npy(tmp_path / "a.npy", 60, 40)
    assert isinstance(found, list)
    np.testing.assert_array_equal([each.mask for each in found], masks)
    assert [each.label for each in found] == [1, 2, 3]


def test_npy_files_that_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, {"masks": LABELS})
    with pytest.raises(InputError, match=r"a.npy: cannot be read, .* \(it holds Python obj"):
        read_npy(path, 60, 40)
    for array in (LABELS.T, LABELS[None, None], np.zeros(()), np.zeros(7)):
        np.save(path, array)
        with pytest.raises(InputError, match=r"a.npy: its shape is .*, expected 40 x 60, or N x 40 x 60"):
            read_npy(path, 60, 40)
    np.save(path, np.zeros((40, 60, 3), bool))
    with pytest.raises(InputError, match=r"N x 40 x 60: np.moveaxis\(masks, -1, 0\) makes that of it"):
        read_npy(path, 60, 40)
    np.save(path, LABELS[None].astype(complex))
    with pytest.raises(InputError, match=r"a.npy: holds a stack of complex128, expected masks of bool"):
        read_npy(path, 60, 40)
    soft = np.full((2, 40, 60), 0.7, np.float32)
    for stack, problem in (
        (soft, "fractions, expected masks of 0 and 1: save masks > 0.5"),
        (soft * np.nan, "fractions"),
        (-np.ones((2, 40, 60), np.int8), "negative numbers"),
        (-np.ones((2, 40, 60)), "negative numbers"),
    ):
        np.save(path, stack)
        with pytest.raises(InputError, match=rf"a.npy: holds a stack .*{problem}"):
            read_npy(path, 60, 40)
    np.save(path, LABELS + 0.5)
    with pytest.raises(InputError, match=r"a.npy: holds numbers that are no labels"):
        read_npy(path, 60, 40)
    np.save(path, LABELS)
    whole = path.read_bytes()
    for length in (0, 5, 60, 300):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a.npy: cannot be read, expected an array"):
            read_npy(path, 60, 40)
    path.write_bytes(whole.replace(b"(40, 60)", b"(4000000, 6000000)".ljust(8)))  # more than there is
    with pytest.raises(InputError, match=r"a.npy"):
        read_npy(path, 60, 40)
    with path.open("wb") as file:
        np.savez(file, a=LABELS, b=LABELS)
    with pytest.raises(InputError, match=r"a.npy: holds several arrays"):
        read_npy(path, 60, 40)
    with pytest.raises(InputError, match=r"absent.npy: the mask file is missing"):
        read_npy(tmp_path / "absent.npy", 60, 40)


def test_hostile_pickles_run_nothing(tmp_path: Path) -> None:
    """Not as an array, and not as cellpose's own file, for which the message says what to do."""
    folder, made = write_scene(tmp_path / "plant", 2), tmp_path / "made"
    scene = load_scene(folder)
    for ending, message in ((".npy", "it holds Python objects"), ("_seg.npy", "in cellpose, save the masks as PNG")):
        masks = tmp_path / f"masks{ending}"
        masks.mkdir()
        for view in scene.views:
            np.save(masks / f"{view.name}{ending}", np.array({"masks": Hostile(made)}, dtype=object))
        with pytest.raises(InputError, match=message):
            load_masks(scene, masks)
    assert not made.exists()
    np.load(masks / f"{scene.views[0].name}_seg.npy", allow_pickle=True)  # the file does what it says, where it may
    assert made.is_dir()
