"""The masks of one view as outlines that a browser draws, sharp at every size."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.masks import SURE, Masks

UNITS = 2000  # across the picture of a view: the numbers of its outlines are whole ones
TOLERANCE = 1.5  # units that an outline may differ from the mask
LEAST_HEIGHT, LARGEST_HEIGHT = 36, 110  # units, of a number in the picture

Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class Outline:
    """One mask, in units of the picture, of which it is 2000 wide.

    Attributes:
        region: index of the mask.
        leaf: id of its instance, -1 = matched to nothing.
        path: of SVG; holes are paths of their own (even-odd rule).
        box: xyxy, around all of it.
        at: where its number goes: the middle of the thickest place.
        height: of the number.
        match_score: see `Matching`.
        is_sure: whether that is at least 0.5.
        other: id of a second instance that the mask seems to cover, None for most.
    """

    region: int
    leaf: int
    path: str
    box: Box
    at: tuple[int, int]
    height: int
    match_score: float
    is_sure: bool
    other: int | None

    def as_json(self) -> dict[str, Any]:
        """What the page reads."""
        return asdict(self)


def outline_masks(masks: Masks, *, view: int, box: Box) -> list[Outline]:
    """The masks of one view, large ones first, so that small ones lie on top.

    Args:
        masks: D masks.
        view: index of the view.
        box: xyxy, pixels: the part of the photo that the picture shows. Masks outside are left out.
    """
    regions, others = masks.regions, masks.second_ids.tolist()
    members = ((regions.view_index == view) & (regions.areas > 0)).nonzero()[:, 0]
    members = members[regions.areas[members].argsort(descending=True, stable=True)]
    found = []
    for region in members.tolist():
        mask = regions.crop(region).cpu().numpy().astype(np.uint8)
        corner = np.array(regions.boxes[region, :2].tolist())
        path, around = trace_mask(mask, corner, box=box)
        height = round(UNITS * (box[3] - box[1]) / (box[2] - box[0]))
        if around[2] <= 0 or around[3] <= 0 or around[0] >= UNITS or around[1] >= height:
            continue
        at, thickness = _find_thickest(mask, corner, box=box)
        score = float(masks.match_scores[region])
        found.append(
            Outline(
                region=region,
                leaf=int(masks.instance_ids[region]),
                path=path,
                box=around,
                at=at,
                height=int(np.clip(thickness, LEAST_HEIGHT, LARGEST_HEIGHT)),
                match_score=round(score, 4),
                is_sure=score >= SURE,
                other=others[region] if others[region] > 0 else None,
            )
        )
    return found


def trace_mask(mask: NDArray[np.uint8], corner: NDArray[np.int64], *, box: Box) -> tuple[str, Box]:
    """The outline of one mask as a path of SVG, and the box around it.

    Args:
        mask: (h, w), not 0 in the mask; at least one pixel is.
        corner: (2,) column and row of the photo of its top-left pixel.
        box: the part of the photo that is `UNITS` wide.
    """
    lines, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parts, corners = [], []
    for line in lines:
        placed = _place(line[:, 0] + corner + 0.5, box).astype(np.float32)
        points = np.round(cv2.approxPolyDP(placed, TOLERANCE, True)[:, 0]).astype(int)
        steps = np.diff(points, axis=0).ravel().tolist()
        parts.append(f"M{points[0, 0]} {points[0, 1]}l{' '.join(map(str, steps or [0, 0]))}z")
        corners.append(points)
    x1, y1 = np.concatenate(corners).min(0).tolist()
    x2, y2 = np.concatenate(corners).max(0).tolist()
    return "".join(parts), (x1, y1, x2, y2)


def _find_thickest(mask: NDArray[np.uint8], corner: NDArray[np.int64], *, box: Box) -> tuple[tuple[int, int], float]:
    """The middle of the largest circle in a mask, which is always inside it, and its diameter, both in units."""
    depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    x, y = np.round(_place(np.array([column, row]) + corner + 0.5, box)).astype(int).tolist()
    return (x, y), 2 * float(depth.max()) * UNITS / (box[2] - box[0])


def _place(xy: NDArray[Any], box: Box) -> NDArray[np.float64]:
    """Pixel positions (..., 2) of the photo, in units of the picture."""
    return np.asarray((xy - np.array(box[:2])) * UNITS / (box[2] - box[0]), dtype=np.float64)
