"""Recognises label images that hold something else than a number per leaf: a number per class or photos, whose numbers
have components far apart; and numbers between others, which scaling with interpolation makes along edges."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.regions import IGNORE_LABEL, Regions

BINARY = 255  # definition: written by segmenters that only separate leaf from background
SIDE = 256  # limit: pixels: larger masks are scaled down to this
COMPARABLE = 0.2  # chosen: of the largest component's area: smaller ones are ignored
FAR = 0.5  # chosen: gap between components, in the square root of the smaller one's area
MANY = 0.5  # chosen: share of the photos, or of the numbers of one
PHOTO = 50  # chosen: numbers of a label image: with more, it may be a photo
# chosen: of the pixels at edges, those between their neighbours. Masks of 12 real plants and a simulated one have 0.06
# at most (0.08 in the worst photo, of a seedling); those that OpenCV scaled by 0.25 to 4 have 0.13 to 0.58.
BETWEEN = 0.1
FEWEST = 500  # chosen: pixels at edges of all photos, below which that share means nothing


def check_numbers(regions: Regions, between: np.ndarray, *, source: object) -> None:
    """Warn (InputWarning) if label images hold 0 and 255 only, or if a number has components far apart in most of the
    photos with masks. `between` is the sum of the `count_between` of all label images; messages name `source`.

    A partly occluded leaf has several components, too, but near each other or in few photos: on basil and maize with a
    number per leaf, in less than a third of the photos. Raises InputError if most of the many numbers of a view have
    components far apart, as the grey values of a photo do, or if label images were scaled, see `is_interpolated`.
    """
    if len(regions) and bool((regions.labels == BINARY).all()):
        warn(Finding("one_number", str(source)))
        return
    is_apart = [has_components_apart(regions.crop(index).numpy()) for index in range(len(regions))]
    in_view = Counter(view for view, apart in zip(regions.view_index.tolist(), is_apart, strict=True) if apart)
    for view, total in enumerate(regions.num_per_view.tolist()):
        if total > PHOTO and in_view[view] > MANY * total:
            reason = f"holds {total} numbers with parts far apart: is it a photo? expected one number per leaf"
            raise InputError(f"{source}: the label image of view {view} {reason}")
    if is_interpolated(between):
        raise InputError(f"{source}: {INTERPOLATED}")
    with_number = Counter(number for number, apart in zip(regions.labels.tolist(), is_apart, strict=True) if apart)
    num_photos = int((regions.num_per_view > 0).sum())
    number, count = with_number.most_common(1)[0] if with_number else (0, 0)
    if count > max(1, MANY * num_photos):
        warn(Finding("class_numbers", str(source), {"number": number, "count": count, "total": num_photos}))


INTERPOLATED = (
    "numbers lie along the edges of others, between them in value: were the label images scaled with interpolation? "
    "scale them to the nearest pixel"
)


def count_between(labels: np.ndarray) -> np.ndarray:
    """(2,) int64, of a label map (H, W) uint16: the pixels at edges, which have a neighbour (of 8) of another number;
    and those of them that have one of a lower number and one of a higher one. There are a few where three leaves meet,
    and many along all edges where a label image was scaled with interpolation."""
    rows, columns = (np.flatnonzero(labels.any(axis)) for axis in (1, 0))
    if not len(rows):
        return np.zeros(2, np.int64)
    part = labels[max(rows[0] - 1, 0) : rows[-1] + 2, max(columns[0] - 1, 0) : columns[-1] + 2]
    part = np.where(part == IGNORE_LABEL, 0, part).astype(np.uint16)
    low, high = minimum_filter(part, 3, mode="nearest"), maximum_filter(part, 3, mode="nearest")  # without threads
    return np.array([np.count_nonzero(low != high), np.count_nonzero((low < part) & (part < high))])


def is_interpolated(between: np.ndarray) -> bool:
    """Whether label images were scaled with interpolation, by the sum of their `count_between`."""
    return bool(between[0] >= FEWEST and between[1] > BETWEEN * between[0])


def has_components_apart(mask: np.ndarray) -> bool:
    """Whether (h, w) bool holds two components of comparable size with a gap between them."""
    scale = min(1.0, SIDE / max(mask.shape))
    size = (max(1, round(scale * mask.shape[1])), max(1, round(scale * mask.shape[0])))
    small = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    _, components, stats, _ = cv2.connectedComponentsWithStats(small, connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    largest = int(areas.argmax())
    distance = cv2.distanceTransform((components != largest).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    others = [index for index in np.flatnonzero(areas >= COMPARABLE * areas[largest]) if index != largest]
    return any(distance[components == index].min() > FAR * areas[index] ** 0.5 for index in others[:SIDE])
