"""NumPy files: `.npy` with labels (H, W) or (1, H, W), or with a stack of masks (N, H, W). Nothing is unpickled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvseg.errors import InputError
from mvseg.formats.label_png import labels_of_numbers
from mvseg.formats.masks.found_mask import FoundMask


def read_npy(path: Path, width: int, height: int) -> np.ndarray | list[FoundMask]:
    """The (height, width) uint16 labels of a photo, or its masks, numbered from 1, where the file holds a stack: pixels
    that are not 0, in whole numbers of any type, floats included. Raises InputError if the file is no array of numbers,
    or has another size, or a stack holds fractions or negative numbers."""
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
        if array.shape[:2] == (height, width):
            expected += ": np.moveaxis(masks, -1, 0) makes that of it"
        raise InputError(f"{path}: its shape is {shape or 'empty'}, {expected}")
    if has_labels(array):
        labels = np.asarray(array).reshape(height, width)
        return labels_of_numbers(path, labels.astype(np.uint8) if labels.dtype == bool else labels)
    if array.dtype.kind not in "buif":
        raise InputError(f"{path}: holds a stack of {array.dtype}, expected masks of bool or whole numbers")
    return [FoundMask(number, _mask_of(path, np.asarray(mask))) for number, mask in enumerate(array, start=1)]


def has_labels(array: np.ndarray) -> bool:
    """Whether an array holds a label map: (H, W), or (1, H, W) with several numbers above 0, as models return it."""
    if array.ndim != 3 or len(array) != 1 or array.dtype.kind not in "iu":
        return array.ndim == 2
    numbers = array[array > 0]
    return bool(numbers.size and (numbers != numbers[0]).any())


def _mask_of(path: Path, numbers: np.ndarray) -> np.ndarray:
    if numbers.dtype.kind == "f" and not (np.isfinite(numbers) & (numbers == np.floor(numbers))).all():
        raise InputError(f"{path}: holds a stack of fractions, expected masks of 0 and 1: save masks > 0.5")
    if numbers.dtype.kind in "if" and (numbers < 0).any():
        raise InputError(f"{path}: holds a stack with negative numbers, expected masks of 0 and 1")
    return np.asarray(numbers != 0)
