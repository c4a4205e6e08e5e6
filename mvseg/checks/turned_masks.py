"""Masks that hardly fit those of other views: were they drawn on photos that EXIF turns by 180 degrees?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvseg.checks.numbers import AGREEMENT
from mvseg.checks.poses import PoseAgreement, is_sure, pairwise_agreement, view_agreement
from mvseg.findings.finding import Finding
from mvseg.regions import Regions
from mvseg.scene import Cameras


def low_fit_findings(
    regions: Regions, cameras: Cameras, agreement: PoseAgreement, *, is_detected: bool = False
) -> list[Finding]:
    """Nothing where masks fit in most views, or masks or views are few. Else an error, if masks that are turned by 180
    degrees fit twice as well; and a note, if not: leaves that hide each other do that, too. Masks that a detector found
    are not turned."""
    if not agreement.num_masks.any() or not is_sure(agreement):
        return []
    share = float(np.nanmedian(view_agreement(agreement).fitting))
    if share >= AGREEMENT.low:
        return []
    if is_detected:
        return [Finding("low_fit_detected", values={"share": share}, level="note")]
    turned = pairwise_agreement(turn_by_180(regions, cameras), cameras)
    other = float(np.nanmedian(view_agreement(turned).fitting)) if turned.num_masks.any() else 0.0
    if other > AGREEMENT.turned * share:
        return [Finding("turned_masks", values={"share": share, "turned": other}, level="error")]
    return [Finding("low_fit", values={"share": share}, level="note")]


def turn_by_180(regions: Regions, cameras: Cameras) -> Regions:
    """The masks as they would be in photos that are turned by 180 degrees."""
    sizes = cameras.sizes[regions.view_index]
    low, high = sizes - regions.boxes[:, 2:], sizes - regions.boxes[:, :2]
    crops = [regions.crop(index).flatten().flip(0) for index in range(len(regions))]
    return replace(regions, boxes=torch.cat((low, high), 1), crops=torch.cat(crops) if crops else regions.crops)
