"""Colour cards of 24 patches (ColorChecker Classic) in photos: where they are, and what a photo shows there.

A card file gives the corners of a card that cannot be detected, or the views that a card is for:

    {"format": "mvseg-color-card/1",
     "cards": [{"photo": "left.jpg", "views": "left*"},
               {"photo": "right.jpg", "views": "right*", "corners": [[120, 80], [420, 90], [410, 280], [115, 270]]}]}

`photo` lies beside the card file, `views` is a pattern of view names (default: all), and `corners`
are the pixels of the centres of the corner patches, clockwise from the brown one: brown, bluish green, black, white.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FiniteFloat

from mvseg.errors import InputError, faults_of
from mvseg.formats.image_file import PHOTO_SUFFIXES, read_rgb
from mvseg.formats.json_file import Items, read_json

Floats = NDArray[np.float64]
Pixel = tuple[FiniteFloat, FiniteFloat]

ROWS, COLUMNS = 4, 6
# centres of patches on the card, in patches: of all, row by row, and of those in the corners, clockwise
CENTERS = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), -1).reshape(-1, 2).astype(float)
CORNERS = (0, COLUMNS - 1, ROWS * COLUMNS - 1, (ROWS - 1) * COLUMNS)
INSIDE = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 9)] * 2), -1).reshape(-1, 2)  # of a patch: sampled places
LONGEST = 1600  # pixels; OpenCV looks for cards in photos no larger than this
SCALES = (1.0, 0.8, 0.64, 1.25, 1.6)  # it finds a card at one scale that it misses at another
STARTS = 5  # its clustering of colours starts at random, and depends on the number of threads


class CardEntry(BaseModel):
    """One card of a card file, as the head of this module says."""

    model_config = ConfigDict(extra="forbid")
    photo: str
    views: str = "*"
    corners: tuple[Pixel, Pixel, Pixel, Pixel] | None = None


class _CardFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    format: Literal["mvseg-color-card/1"]
    cards: Items[CardEntry]


def read_card_file(path: Path) -> list[tuple[CardEntry, list[Floats]]]:
    """The cards of a card file, or the one in a photo, each with the candidates for its patches.

    Returns:
        Per card (24, 3) sRGB values from 0 to 255, row by row from the brown patch; if the card had to be detected, one
        array for each candidate.

    Raises:
        InputError: the file or a photo is missing or broken, the corners lie outside of the photo, or there is no card.
    """
    if path.suffix.lower() in PHOTO_SUFFIXES:
        entries = [CardEntry(photo=path.name)]
    else:
        entries = read_json(path, _CardFile).cards
    if not entries:
        raise InputError(f"{path}: names no cards, expected one or more")
    found = []
    for entry in entries:
        file = path.parent / entry.photo
        with faults_of(f"{file}: the photo of a colour card cannot be read"):
            photo = read_rgb(file)
        if entry.corners is None:
            patches = list(find_patches(photo))
            if not patches:
                what = "no colour card of 24 patches is found, expected one that fills a tenth of the photo or more"
                raise InputError(f"{file}: {what}, or its 'corners' in a card file")
        else:
            corners = np.array(entry.corners)
            if not _is_inside(corners, photo) or cv2.contourArea(corners.astype(np.float32)) < ROWS * COLUMNS:
                size = f"{photo.shape[1]} x {photo.shape[0]} pixels"
                raise InputError(f"{file}: the 'corners' of its colour card span no card within the photo of {size}")
            patches = [look_at_patches(photo, corners)]
        found.append((entry, patches))
    return found


def find_patches(photo: NDArray[np.uint8]) -> Iterator[Floats]:
    """(24, 3) sRGB values, from 0 to 255, of every candidate for a card that OpenCV finds, scale by scale.

    Args:
        photo: (H, W, 3) uint8 RGB.

    Raises:
        InputError: this OpenCV cannot look for cards (those before 5 cannot, without their contributed modules).
    """
    if not hasattr(cv2, "mcc"):
        what = f"OpenCV {cv2.__version__} cannot look for colour cards, expected version 5 or later, or the card's "
        raise InputError(f"{what}'corners' in a card file")
    smaller = min(1.0, LONGEST / max(photo.shape[:2]))
    smooth = cv2.medianBlur(photo, 5)  # noise hides the edges of patches
    for seed in range(STARTS):
        found = []
        for scale, given in itertools.product(SCALES, (photo, smooth)):
            factor = smaller * scale
            kind = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
            shown = np.asarray(cv2.resize(given, None, fx=factor, fy=factor, interpolation=kind), np.uint8)
            corners = _find_corners(shown, seed)
            if corners is not None and _is_inside(corners / factor, photo):
                found.append(look_at_patches(photo, corners / factor))
        yield from found
        if found:
            return


def _find_corners(photo: NDArray[np.uint8], seed: int) -> Floats | None:
    """(4, 2) pixels, as in a card file; None where OpenCV sees no card."""
    detector = cv2.mcc.CCheckerDetector.create()
    cv2.setRNGSeed(seed)
    if not detector.process(np.ascontiguousarray(photo[..., ::-1]), 1):
        return None
    quads = np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(-1, 4, 2)
    return quads.mean(1)[list(CORNERS)] + 0.5 if len(quads) == ROWS * COLUMNS else None


def look_at_patches(photo: NDArray[np.uint8], corners: Floats) -> Floats:
    """(24, 3) medians of the patches' sRGB values; `corners` (4, 2) as in a card file."""
    px_from_card = cv2.getPerspectiveTransform(CENTERS[list(CORNERS)].astype(np.float32), corners.astype(np.float32))
    places = (CENTERS[:, None] + INSIDE).reshape(-1, 1, 2)
    x, y = np.floor(cv2.perspectiveTransform(places, px_from_card)).astype(int).reshape(-1, 2).T
    height, width = photo.shape[:2]
    looked_at = photo[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return np.median(looked_at.reshape(len(CENTERS), len(INSIDE), 3).astype(float), axis=1)


def _is_inside(corners: Floats, photo: NDArray[np.uint8]) -> bool:
    return bool((corners >= 0).all() and (corners <= photo.shape[1::-1]).all())
