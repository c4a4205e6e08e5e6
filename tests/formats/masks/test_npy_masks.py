"""NumPy files and cellpose's: arrays come back, and nothing in a file is ever run."""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.masks.cellpose import read_cellpose
from mvseg.formats.masks.npy_masks import read_npy

LABELS = (np.arange(40 * 60).reshape(40, 60) // 100).astype(np.uint16)


class Hostile:
    """Unpickled by pickle itself, it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = str(folder)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.folder,)


def write_pickle(path: Path, content: Any, protocol: int) -> None:
    """As np.save writes objects, of any protocol; NumPy's own is 4, and was 3."""
    holder = np.empty((), object)
    holder[()] = content
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(holder))
        pickle.dump(holder, file, protocol=protocol)


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


@pytest.mark.parametrize("protocol", [3, 4])
@pytest.mark.parametrize("masks", [LABELS, LABELS.astype(np.int32), np.asfortranarray(LABELS), LABELS.astype(">u4")])
def test_cellpose_files(masks: np.ndarray, protocol: int, tmp_path: Path) -> None:
    """The keys that cellpose's `masks_flows_to_seg` and its window write."""
    content = {
        "outlines": LABELS, "colors": np.zeros((24, 3), np.uint8), "masks": masks, "chan_choose": [0, 0],
        "ismanual": np.zeros(24, bool), "filename": "a.png", "diameter": np.nan, "model_path": 0,
        "flows": [np.zeros((1, 4, 6, 3), np.uint8), np.zeros((4, 6), np.float32), [], [None, np.float32(3)]],
        "manual_changes": [], "est_diam": np.float64(30.0), "zdraw": [None], "normalize_params": {"invert": False},
    }  # fmt: skip
    write_pickle(tmp_path / "a_seg.npy", content, protocol)
    np.testing.assert_array_equal(read_cellpose(tmp_path / "a_seg.npy", 60, 40), LABELS)
    write_pickle(tmp_path / "a_seg.npy", {"masks": masks}, protocol)
    np.testing.assert_array_equal(read_cellpose(tmp_path / "a_seg.npy", 60, 40), LABELS)


def test_what_np_save_writes_is_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a_seg.npy", {"masks": LABELS, "filename": "a.png"})
    np.testing.assert_array_equal(read_cellpose(tmp_path / "a_seg.npy", 60, 40), LABELS)


def test_hostile_pickles_run_nothing(tmp_path: Path) -> None:
    path, made = tmp_path / "a_seg.npy", tmp_path / "made"
    for content in (Hostile(made), {"masks": Hostile(made)}, {"masks": LABELS, "more": Hostile(made)}):
        write_pickle(path, content, 4)
        with suppress(InputError):
            read_cellpose(path, 60, 40)
        assert not made.exists()
    np.load(path, allow_pickle=True)  # the file does what it says, where it is allowed to
    assert made.is_dir()


@pytest.mark.parametrize(
    "opcodes",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x011\x85R.",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00.",  # a byte array of 2^48 bytes
        b"\x80\x04r\xff\xff\xff\xff.",  # a note under number 2^32
        b"\x80\x04P1\n.",  # a reference to elsewhere
        b"\x80\x04}" + b")\x85" + b"\x85" * 500_000 + b"K\x01s.",  # a key nested so deep that its hash overflows
        b"\x80\x04]\x81.",
        b"",
    ],
)
def test_malformed_pickles_are_refused(opcodes: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a_seg.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(opcodes)
    with pytest.raises(InputError, match=r"a_seg.npy: is not as cellpose writes it; in cellpose, save the masks"):
        read_cellpose(path, 60, 40)


def test_cellpose_files_that_do_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "a_seg.npy"
    np.save(path, {"masks": LABELS})
    with pytest.raises(InputError, match=r"a_seg.npy: the mask is 60 x 40, its camera says 60 x 41"):
        read_cellpose(path, 60, 41)
    whole = path.read_bytes()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a_seg.npy: is not as cellpose writes it"):
            read_cellpose(path, 60, 40)
    for content in ([LABELS], {"labels": LABELS}, {"masks": [1, 2]}, {"masks": LABELS.astype(float)}, LABELS):
        np.save(path, np.array(content, dtype=object) if isinstance(content, list) else content)
        with pytest.raises(InputError, match=r"a_seg.npy: is not as cellpose writes it"):
            read_cellpose(path, 60, 40)
