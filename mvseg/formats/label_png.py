"""Label images: 16-bit (or 8-bit) single-channel PNGs; 0 = nothing, 65535 = ignore, every other number one mask."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mvseg.errors import InputError
from mvseg.formats.image_file import read_image, write_png


def read_label_png(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) uint16 label map.

    Raises:
        InputError: the file is missing, cannot be decoded, has colour channels, is not 8 or 16 bits deep, or is of
            another size than `width` x `height`.
    """
    if not path.is_file():
        raise InputError(f"{path}: the mask file is missing")
    labels = read_image(path, cv2.IMREAD_UNCHANGED)
    if labels is None:
        raise InputError(f"{path}: cannot be read, expected a whole label PNG")
    if labels.ndim != 2:
        raise InputError(f"{path}: has {labels.shape[2]} colour channels, expected a label PNG with a single channel")
    if labels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: holds {labels.dtype} numbers, expected 8 or 16 bits without sign")
    if labels.shape != (height, width):
        size = f"{labels.shape[1]} x {labels.shape[0]}"
        raise InputError(f"{path}: the mask is {size}, its camera says {width} x {height}")
    return labels.astype(np.uint16)


def write_label_png(path: Path, labels: np.ndarray) -> None:
    """Write an integer label map (H, W) with values in [0, 65535] as a 16-bit PNG; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, labels.astype(np.uint16))
