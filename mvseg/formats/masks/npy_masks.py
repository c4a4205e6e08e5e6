"""NumPy files: `.npy` with labels (H, W), or with a stack of masks (N, H, W). Nothing is ever unpickled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvseg.errors import InputError
from mvseg.formats.label_png import labels_of_numbers
from mvseg.formats.masks.found_mask import FoundMask


def read_npy(path: Path, width: int, height: int) -> np.ndarray | list[FoundMask]:
    """The (height, width) uint16 labels of a photo, or its masks, numbered from 1, where the file holds a stack.

    The masks of a stack are what is not 0, in whole numbers of any type, floats included.

    Raises:
        InputError: the file is no array of numbers, or has another size; a stack holds fractions or negative numbers.
    """
    if not path.is_file():
        raise InputError(f"{path}: the mask file is missing")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # the size is checked before anything is read
    except Exception as error:  # numpy raises many kinds on a damaged head
        has_objects = "Object arrays" in str(error) or "memory-mapped" in str(error)
        reason = "it holds Python objects" if has_objects else "it is damaged"
        raise InputError(f"{path}: cannot be read, expected an array of labels or masks ({reason})") from None
    if not isinstance(array, np.ndarray):
        array.close()
        raise InputError(f"{path}: holds several arrays, expected one in a .npy file")
    if array.shape[-2:] != (height, width) or array.ndim not in (2, 3):
        shape = " x ".join(map(str, array.shape))
        expected = f"expected {height} x {width}, or N x {height} x {width}"
        raise InputError(f"{path}: its shape is {shape or 'empty'}, {expected}")
    if array.ndim == 2:
        return labels_of_numbers(path, np.asarray(array, np.uint8) if array.dtype == bool else np.asarray(array))
    if array.dtype.kind not in "buif":
        raise InputError(f"{path}: holds a stack of {array.dtype}, expected masks of bool or whole numbers")
    return [FoundMask(number, _mask_of(path, np.asarray(mask))) for number, mask in enumerate(array, start=1)]


def _mask_of(path: Path, numbers: np.ndarray) -> np.ndarray:
    """(H, W) bool of one mask of a stack."""
    if numbers.dtype.kind == "f" and not (np.isfinite(numbers) & (numbers == np.floor(numbers))).all():
        raise InputError(f"{path}: holds a stack of fractions, expected masks of 0 and 1: save masks > 0.5")
    if numbers.dtype.kind in "if" and (numbers < 0).any():
        raise InputError(f"{path}: holds a stack with negative numbers, expected masks of 0 and 1")
    return np.asarray(numbers != 0)
