"""One mask while edits are applied to it: where a line cuts it, and the table of the masks after all edits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.crop import Crop
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.numbers import IMAGE
from mvseg.regions import stack_regions

Key = tuple[int, int]  # of a mask: the edit that made it, or 0, and which of its masks it is


@dataclass(frozen=True, eq=False)
class EditedMask:
    """One mask while edits are applied: the `row` of the table that it was (-1: none), the `edits` that made it."""

    key: Key
    view: int
    crop: Crop
    row: int
    origin: int
    edits: tuple[int, ...] = ()


def side_of(line: NDArray[np.float64], crop: Crop) -> Tensor:
    """(h, w) bool: the pixels of a mask's box on one side of a line, which goes on straight at its ends."""
    height, width = crop.pixels.shape
    line = line - crop.box[:2]
    far = 4.0 * (width + height + np.abs(line).max())
    steps = [line[0] - line[1], line[-1] - line[-2]]
    ends = [step / max(float(np.hypot(*step)), 1e-9) * far for step in steps]
    line = np.concatenate(([line[0] + ends[0]], line, [line[-1] + ends[1]]))
    along = line[-1] - line[0]
    aside = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * far
    polygon = np.concatenate((line, [line[-1] + aside, line[0] + aside])) - 0.5  # from pixel corners to centres
    side = np.zeros((height, width), np.uint8)
    cv2.fillPoly(side, [np.round(polygon * 2**IMAGE.sub_pixel_bits).astype(np.int32)], 1, shift=IMAGE.sub_pixel_bits)
    return torch.from_numpy(side > 0)


def as_table(masks: Masks, made: Sequence[EditedMask]) -> Masks:
    """The table of the masks that are left. Those drawn where none was have the commonest class; what was drawn has no
    score. Masks that edits made, or changed, have proposals of their own, from -1 downwards."""
    if not made:
        return Masks.of(masks.regions).select(torch.zeros(0, dtype=torch.int64))
    rows = torch.tensor([mask.row for mask in made])
    origin = torch.tensor([mask.origin for mask in made])
    classes, scores, labels = torch.ones_like(rows), torch.full((len(made),), torch.nan), torch.zeros_like(rows)
    proposal = -1 - torch.arange(len(made))
    if len(masks):
        is_new, chosen = rows < 0, rows.clamp(min=0)
        classes = torch.where(is_new, masks.classes.mode()[0], masks.classes[chosen])
        scores = torch.where(origin == Origin.CORRECTED, torch.nan, masks.detection_scores[chosen])
        labels = torch.where(is_new, 0, masks.regions.labels[chosen])
        is_same = torch.tensor([_is_untouched(mask, masks) for mask in made])
        proposal = torch.where(is_same, masks.proposal[chosen], proposal)
    of_made = [(mask.view, mask.crop, label) for mask, label in zip(made, labels.tolist(), strict=True)]
    regions = stack_regions(of_made, masks.regions.num_views)
    return replace(Masks.of(regions, classes=classes, detection_scores=scores), origin=origin, proposal=proposal)


def _is_untouched(mask: EditedMask, masks: Masks) -> bool:
    if mask.key[0] > 0:
        return False
    crop = masks.regions.placed(mask.row)
    return mask.crop.box == crop.box and torch.equal(mask.crop.pixels, crop.pixels)
