"""Parts of the photos that have the colour of leaves and no mask: what was missed there, only the user can say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from mvseg.arrays import Bools, Floats
from mvseg.corrections.numbers import QUESTIONS
from mvseg.corrections.rough_outline import trace_outline
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.verification.picture import FREE, Labels, picture_views


@dataclass(frozen=True, eq=False)
class Unmasked:
    """One part: its view, the row of the mask that it shares its longest border with (-1: none), its area in pixels,
    and its outline (P, 2), pixels, undistorted."""

    view: int
    row: int
    area: float
    outline: Floats


def find_unmasked(masks: Masks, photos: ReadPhoto, *, least_area: float) -> list[Unmasked]:
    """Find parts of at least `least_area` pixels, by view; none where nothing is matched, whose colours tell what
    leaves look like. Long and thin parts, like stems, are left out. Of a very large part, or one that reaches the edge
    of the photo, the widest place counts: several leaves hang together there, or the ground."""
    if not masks.num_instances:
        return []
    pictures = enumerate(picture_views(masks, photos))
    return [part for view, (rows, step) in pictures for part in _parts(rows, view, step=step, least_area=least_area)]


def _parts(rows: Labels, view: int, *, step: int, least_area: float) -> Iterator[Unmasked]:
    is_free, kernel = (rows == FREE).astype(np.uint8), np.ones((QUESTIONS.opening,) * 2, np.uint8)
    opened = cv2.morphologyEx(is_free, cv2.MORPH_OPEN, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    (height, width), beside = rows.shape, QUESTIONS.beside
    for label in range(1, count):
        left, top, wide, high, area = stats[label].tolist()
        if area * step**2 < least_area:
            continue
        is_inside = left > 0 and top > 0 and left + wide < width and top + high < height
        if not is_inside or area > QUESTIONS.most_share * rows.size:
            labels = np.where(_widest_place(labels == label), label, np.where(labels == label, 0, labels))
            left, top, wide, high = cv2.boundingRect((labels == label).astype(np.uint8))
            area = int((labels == label).sum())
            if area * step**2 < least_area:
                continue
        box = np.s_[max(top - beside, 0) : top + high + beside, max(left - beside, 0) : left + wide + beside]
        part = (labels[box] == label).astype(np.uint8)
        if (2 * cv2.distanceTransform(np.pad(part, 1), cv2.DIST_L2, 3).max()) ** 2 < QUESTIONS.compact * area:
            continue
        touched = rows[box][cv2.dilate(part, np.ones((2 * beside + 1,) * 2, np.uint8)) > 0]
        touching, numbers = np.unique(touched[touched >= 0], return_counts=True)
        corner = np.array([box[1].start, box[0].start])
        yield Unmasked(
            view=view,
            row=int(touching[numbers.argmax()]) if len(touching) else -1,
            area=float(area * step**2),
            outline=(trace_outline(part) + corner) * step,
        )


def _widest_place(part: Bools) -> Bools:
    """(h, w) of a part, what lies around the middle of its largest circle, up to `QUESTIONS.widest` radii away."""
    distance = cv2.distanceTransform(np.pad(part.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(distance.argmax()), part.shape)
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    return np.asarray(part & (np.hypot(rows - row, columns - column) <= QUESTIONS.widest * distance[row, column]))
