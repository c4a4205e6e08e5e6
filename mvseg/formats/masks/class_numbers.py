"""Recognises label images with a number per class instead of per leaf, and photos: their numbers have components far
apart."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from mvseg.errors import InputError, warn
from mvseg.regions import Regions

SIDE = 256  # pixels: larger masks are scaled down to this
COMPARABLE = 0.2  # of the largest component's area: smaller ones are ignored
FAR = 0.5  # gap between components, in the square root of the smaller one's area
MANY = 0.5  # share of the photos, or of the numbers of one
PHOTO = 50  # numbers of a label image: with more, it may be a photo


def check_numbers(regions: Regions, *, source: Path) -> None:
    """Warn (InputWarning) if a number of label images has components far apart in most of the photos with masks.

    A partly occluded leaf has several components, too, but near each other or in few photos: on basil and maize with a
    number per leaf, in less than a third of the photos.

    Raises:
        InputError: most of the many numbers of a view have components far apart, as the grey values of a photo do.
    """
    is_apart = [has_components_apart(regions.crop(index).numpy()) for index in range(len(regions))]
    in_view = Counter(view for view, apart in zip(regions.view_index.tolist(), is_apart, strict=True) if apart)
    for view, total in enumerate(regions.num_per_view.tolist()):
        if total > PHOTO and in_view[view] > MANY * total:
            reason = f"holds {total} numbers with parts far apart: is it a photo? expected one number per leaf"
            raise InputError(f"{source}: the label image of view {view} {reason}")
    with_number = Counter(number for number, apart in zip(regions.labels.tolist(), is_apart, strict=True) if apart)
    num_photos = int((regions.num_per_view > 0).sum())
    number, count = with_number.most_common(1)[0] if with_number else (0, 0)
    if count > max(1, MANY * num_photos):
        message = f"the number {number} has parts far apart in {count} of {num_photos} photos, as a class does"
        advice = "export a number per leaf (VOC's SegmentationObject, not SegmentationClass), or COCO"
        warn(f"{source}: {message}: {advice}")


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
