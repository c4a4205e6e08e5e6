"""Label images: PNGs of 16 (or 8) bits with a single channel; 0 = nothing, 65535 = ignore, any other number = one mask.

A palette PNG gives its indices, not its colours: the tools that write labels with a palette (as PASCAL VOC's are) mean
the index. VOC's border of 255 around its numbers is ignored. `masks/label_image.py` reads more kinds of label images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.image_file import WrongSize, read_image, write_png
from mvseg.regions import IGNORE_LABEL

VOC_BORDER = 255  # index, in palette PNGs


def read_label_png(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) uint16 label map of a view.

    Raises:
        InputError: as `read_labels`, or another size than `width` x `height`.
    """
    return labels_of(open_labels(path, (width, height)), path)


def read_labels(path: Path) -> np.ndarray:
    """(H, W) uint16 label map of whatever size.

    Raises:
        InputError: the file is missing, cannot be decoded, is a JPEG, has colour channels, or does not hold
            unsigned numbers of at most 16 bits.
    """
    return labels_of(open_labels(path), path)


def open_labels(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """The decoded image of a label file; one of another size (width, height) than its camera states is not decoded.

    Raises:
        InputError: it is missing, cannot be decoded, is a JPEG, or is of another size.
    """
    if not path.is_file():
        raise InputError(f"{path}: the mask file is missing")
    try:
        image = read_image(path, size)
        if size is not None and image.size != size:
            raise WrongSize(image.width, image.height)
    except WrongSize as error:
        expected = "" if size is None else f", its camera says {size[0]} x {size[1]}"
        raise InputError(f"{path}: the mask is {error.width} x {error.height}{expected}") from None
    except InputError as error:
        raise InputError(f"{path}: cannot be read, expected a whole label PNG: {error}") from None
    if image.format == "JPEG":
        raise InputError(f"{path}: is a JPEG, which blurs the numbers of masks: export PNG instead")
    return image


def labels_of(image: Image.Image, path: Path) -> np.ndarray:
    """(H, W) uint16 from a decoded image; see `read_labels`."""
    num_channels = len(image.getbands())
    if num_channels > 1:
        raise InputError(f"{path}: has {num_channels} colour channels, expected a label PNG with a single channel")
    if image.mode in ("I", "F"):
        raise InputError(f"{path}: holds signed or 32-bit numbers, expected 8 or 16 bits without sign")
    labels = np.array(image.convert("L") if image.mode == "1" else image).astype(np.uint16)
    if image.mode == "P" and ((labels > 0) & (labels < VOC_BORDER)).any():
        labels[labels == VOC_BORDER] = IGNORE_LABEL
    return labels


def write_label_png(path: Path, labels: np.ndarray) -> None:
    """Write an integer label map (H, W) with values in [0, 65535] as a 16-bit PNG; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, labels.astype(np.uint16))
