"""One image per mask: whatever is not black belongs to it. SAM's own script, BOP and many segmenters write so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvseg.formats.label_png import open_labels
from mvseg.formats.masks.found_mask import FoundMask


def read_mask_images(paths: Sequence[Path], width: int, height: int) -> list[FoundMask]:
    """The masks of one photo, numbered from 1 in the order of the paths; they may overlap.

    Raises:
        InputError: a file cannot be decoded, is a JPEG, or has another size.
    """
    return [FoundMask(number, _read_mask(path, width, height)) for number, path in enumerate(paths, start=1)]


def _read_mask(path: Path, width: int, height: int) -> np.ndarray:
    image = open_labels(path, (width, height))
    if image.mode in ("RGBA", "LA"):
        channels = np.asarray(image)
        return np.asarray(channels[..., :-1].any(2) & (channels[..., -1] > 0))
    pixels = np.asarray(image)
    return np.asarray(pixels != 0 if pixels.ndim == 2 else pixels.any(2))
