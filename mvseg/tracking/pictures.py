"""Small pictures of the leaves of a result, for the page."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps

from mvseg.errors import InputError
from mvseg.formats.image_file import encode_jpeg, read_rgb
from mvseg.results.photo_masks import labels_in_photo
from mvseg.results.result import Result

SIDE, QUALITY = 72, 70  # pixels and JPEG quality of a picture (a definition)
LIT, DARK = np.uint8(200), np.uint8(24)  # greys of a mask and around it without a photo (a definition)


def picture_leaves(result: Result, leaves: Collection[int]) -> dict[int, bytes]:
    """{leaf: JPEG} of where each of the leaves is largest: of the photo if it is still there, else of its mask; none of
    a leaf without a mask."""
    labels = [labels_in_photo(result, view) for view in range(len(result.scene.views))]
    count = max(leaves, default=0) + 1
    sizes = np.array([np.bincount(np.minimum(view, count).ravel(), minlength=count + 1) for view in labels])
    pictures: dict[int, bytes] = {}
    for view, about in enumerate(result.scene.views):
        shown = [leaf for leaf in leaves if sizes[:, leaf].argmax() == view and sizes[view, leaf]]
        photo = _photo(about.path, labels[view].shape) if shown else None
        pictures |= {leaf: cut_picture(photo, labels[view] == leaf) for leaf in shown}
    return pictures


def _photo(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    """A photo as it is stored, if it still is where the run found it, can be read, and has its size."""
    with suppress(InputError):
        photo = read_rgb(path) if path.is_file() else None
        return None if photo is None or photo.shape[:2] != shape else photo
    return None


def cut_picture(photo: np.ndarray | None, mask: np.ndarray) -> bytes:
    """A square around a mask (H, W) in its photo (H, W, 3), the rest of it dark."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    half, row, column = max(width, height) // 2 + 4, y + height // 2, x + width // 2
    box = np.s_[max(row - half, 0) : row + half, max(column - half, 0) : column + half]
    is_leaf = mask[box][..., None].repeat(3, axis=2)
    shown = np.where(is_leaf, LIT, DARK) if photo is None else np.where(is_leaf, photo[box], photo[box] // 2)
    image = ImageOps.contain(Image.fromarray(np.ascontiguousarray(shown)), (SIDE, SIDE), Image.Resampling.BOX)
    return encode_jpeg(np.asarray(image), quality=QUALITY)
