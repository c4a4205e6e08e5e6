"""Masks that hardly fit those of other views: drawn on photos turned by 180 degrees, or padded, or transposed?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch

from mvseg.checks.numbers import AGREEMENT
from mvseg.checks.poses import PoseAgreement, is_sure, pairwise_agreement, view_agreement
from mvseg.crop import Crop
from mvseg.findings.finding import Finding
from mvseg.regions import Regions, stack_regions
from mvseg.scene import Cameras


def low_fit_findings(
    regions: Regions, cameras: Cameras, agreement: PoseAgreement, *, is_detected: bool = False
) -> list[Finding]:
    """Nothing where masks fit in most views, or masks or views are few. Else an error, if masks fit twice as well once
    they are turned by 180 degrees, or taken out of a square, or transposed; and a note, if not: leaves that hide each
    other do that, too. Masks that a detector found are as they are."""
    if not agreement.num_masks.any() or not is_sure(agreement):
        return []
    share = float(np.nanmedian(view_agreement(agreement).fitting))
    if share >= AGREEMENT.low:
        return []
    if is_detected:
        return [Finding("low_fit_detected", values={"share": share}, level="note")]
    sizes = cameras.sizes
    ways: dict[str, Callable[[Regions, Cameras], Regions]] = {"turned_masks": turn_by_180}
    if (sizes[:, 0] != sizes[:, 1]).all():
        ways["letterboxed_masks"] = take_out_of_square
    elif (sizes[:, 0] == sizes[:, 1]).all():
        ways["transposed_masks"] = transpose
    for code, change in ways.items():
        changed = pairwise_agreement(change(regions, cameras), cameras)
        other = float(np.nanmedian(view_agreement(changed).fitting)) if changed.num_masks.any() else 0.0
        if other > AGREEMENT.turned * share:
            return [Finding(code, values={"share": share, "turned": other}, level="error")]
    return [Finding("low_fit", values={"share": share}, level="note")]


def take_out_of_square(regions: Regions, cameras: Cameras) -> Regions:
    """The masks as they would be if they were drawn on photos that were padded to squares, with corners as shares of
    the squares (letterboxes of YOLO)."""
    crops = []
    for index in range(len(regions)):
        width, height = cameras.sizes[regions.view_index[index]].tolist()
        side = max(width, height)
        scale = np.array([side / width, side / height] * 2)
        shift = np.array([(side - width) / 2, (side - height) / 2] * 2)
        box = np.round(regions.boxes[index].numpy() * scale - shift).astype(int)
        size = max(int(box[2] - box[0]), 1), max(int(box[3] - box[1]), 1)
        crop = cv2.resize(regions.crop(index).numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        moved = Crop((*box.tolist()[:2], int(box[0]) + size[0], int(box[1]) + size[1]), torch.from_numpy(crop > 0))
        crops.append(moved.within((0, 0, width, height)).tighten())
    rows = zip(regions.view_index.tolist(), crops, regions.labels.tolist(), strict=True)
    return stack_regions([*rows], regions.num_views)


def transpose(regions: Regions, _: Cameras) -> Regions:
    """The masks with rows and columns exchanged, of square photos."""
    crops = [regions.crop(index).T.flatten() for index in range(len(regions))]
    return replace(regions, boxes=regions.boxes[:, [1, 0, 3, 2]], crops=torch.cat(crops) if crops else regions.crops)


def turn_by_180(regions: Regions, cameras: Cameras) -> Regions:
    """The masks as they would be in photos that are turned by 180 degrees."""
    sizes = cameras.sizes[regions.view_index]
    low, high = sizes - regions.boxes[:, 2:], sizes - regions.boxes[:, :2]
    crops = [regions.crop(index).flatten().flip(0) for index in range(len(regions))]
    return replace(regions, boxes=torch.cat((low, high), 1), crops=torch.cat(crops) if crops else regions.crops)
