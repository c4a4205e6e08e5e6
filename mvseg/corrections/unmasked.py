"""Parts of the photos that have the colour of leaves and no mask: what was missed there, only the user can say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Bools, Ints
from mvseg.corrections.numbers import QUESTIONS
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.verification.leaf_color import has_leaf_color, thin_views


@dataclass(frozen=True, eq=False)
class Unmasked:
    """One part.

    Attributes:
        view: index of the view.
        row: row of the mask that it shares its longest border with, -1 for none.
        area: pixels.
        outline: (P, 2) float64 pixels, undistorted.
    """

    view: int
    row: int
    area: float
    outline: NDArray[np.float64]


def find_unmasked(masks: Masks, photos: ReadPhoto, *, least_area: float) -> list[Unmasked]:
    """The parts of at least `least_area` pixels, by view; none where nothing is matched, whose colours tell what leaves
    look like. What is long and thin like a stem is left out. Of a very large part, or one that reaches the edge of the
    photo, its widest place counts: several leaves hang together there, or the ground.

    Args:
        masks: D masks on the CPU, matched.
    """
    if not masks.num_instances:
        return []
    views, colors = thin_views(masks, photos, most_px=QUESTIONS.search_px)
    return [
        part
        for view, (photo, rows, step) in enumerate(views)
        for part in _parts(
            has_leaf_color(photo, colors) & (rows < 0), rows, view=view, step=step, least_area=least_area
        )
    ]


def _parts(is_free: Bools, rows: Ints, *, view: int, step: int, least_area: float) -> Iterator[Unmasked]:
    opened = cv2.morphologyEx(is_free.astype(np.uint8), cv2.MORPH_OPEN, np.ones((QUESTIONS.opening,) * 2, np.uint8))
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
        lines, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outline = cv2.approxPolyDP(max(lines, key=cv2.contourArea), 1.0, True)[:, 0]
        corner = np.array([box[1].start, box[0].start])
        yield Unmasked(
            view=view,
            row=int(touching[numbers.argmax()]) if len(touching) else -1,
            area=float(area * step**2),
            outline=np.asarray((outline + corner + 0.5) * step, np.float64),
        )


def _widest_place(part: Bools) -> Bools:
    """(h, w) of a part, what lies around the middle of its largest circle, up to `QUESTIONS.widest` radii away."""
    distance = cv2.distanceTransform(np.pad(part.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(distance.argmax()), part.shape)
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    near: Bools = np.hypot(rows - row, columns - column) <= QUESTIONS.widest * distance[row, column]
    place: Bools = part & near
    return place
