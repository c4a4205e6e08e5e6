"""Small pictures of the leaves of a result, for the page."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps

from mvseg.errors import InputError
from mvseg.formats.image_file import encode_jpeg, read_rgb
from mvseg.results.overlay import find_thickest
from mvseg.results.photo_masks import labels_in_photo
from mvseg.results.result import Result
from mvseg.tracking.numbers import PAGE

LIT, DARK = np.uint8(200), np.uint8(24)  # greys of a mask and around it without a photo (a definition)


@dataclass(frozen=True)
class LeafPicture:
    """A leaf in the photo in which it is largest.

    Attributes:
        jpeg: of the photo around it if it is still there, else of its mask.
        at: x, y of a pixel of the leaf far from its edge, in pixels of the photo.
    """

    jpeg: bytes
    view: str
    at: tuple[float, float]


def draw_pictures(result: Result, leaves: Collection[int], *, side: int) -> tuple[dict[int, LeafPicture], bytes]:
    """{leaf: its picture, `side` pixels wide or high}; none of a leaf without a mask. And a JPEG of all leaves in the
    photo in which they are largest, as `cut_picture`; nothing where there is no mask."""
    labels = [labels_in_photo(result, view) for view in range(len(result.scene.views))]
    count = max(leaves, default=0) + 1
    sizes = np.array([np.bincount(np.minimum(view, count).ravel(), minlength=count + 1) for view in labels])
    pictures: dict[int, LeafPicture] = {}
    for view, about in enumerate(result.scene.views):
        shown = [leaf for leaf in leaves if sizes[:, leaf].argmax() == view and sizes[view, leaf]]
        photo = _photo(about.path, labels[view].shape) if shown else None
        for leaf in shown:
            mask = labels[view] == leaf
            (column, row), _ = find_thickest(mask.astype(np.uint8))
            pictures[leaf] = LeafPicture(cut_picture(photo, mask, side=side), about.name, (column + 0.5, row + 0.5))
    whole = max(range(len(labels)), key=lambda view: np.mean(labels[view] > 0))
    if not labels[whole].any():
        return pictures, b""
    photo = _photo(result.scene.views[whole].path, labels[whole].shape)
    return pictures, cut_picture(photo, labels[whole] > 0, side=PAGE.plant_side)


def _photo(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    with suppress(InputError):
        photo = read_rgb(path) if path.is_file() else None
        return None if photo is None or photo.shape[:2] != shape else photo
    return None


def cut_picture(photo: np.ndarray | None, mask: np.ndarray, *, side: int = PAGE.side) -> bytes:
    """A square around a mask (H, W) in its photo (H, W, 3), the rest of it dark."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    half, row, column = max(width, height) // 2 + 4, y + height // 2, x + width // 2
    box = np.s_[max(row - half, 0) : row + half, max(column - half, 0) : column + half]
    is_leaf = mask[box][..., None].repeat(3, axis=2)
    shown = np.where(is_leaf, LIT, DARK) if photo is None else np.where(is_leaf, photo[box], photo[box] // 2)
    image = ImageOps.contain(Image.fromarray(np.ascontiguousarray(shown)), (side, side), Image.Resampling.BOX)
    return encode_jpeg(np.asarray(image), quality=PAGE.quality)
