"""Masks that hardly fit those of other views: were they drawn on photos that EXIF turns by 180 degrees?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvseg.checks.finding import Finding
from mvseg.checks.numbers import AGREEMENT
from mvseg.checks.poses import PoseAgreement, is_sure, pairwise_agreement, view_agreement
from mvseg.regions import Regions
from mvseg.scene import Cameras


def low_fit_findings(regions: Regions, cameras: Cameras, agreement: PoseAgreement) -> list[Finding]:
    """Nothing where masks fit in most views, or masks or views are few. Else an error, if masks that are turned by 180
    degrees fit twice as well; and a warning, if not."""
    if not agreement.num_masks.any() or not is_sure(agreement):
        return []
    share = np.nanmedian(view_agreement(agreement).fitting)
    if share >= AGREEMENT.low:
        return []
    turned = pairwise_agreement(turn_by_180(regions, cameras), cameras)
    other = np.nanmedian(view_agreement(turned).fitting) if turned.num_masks.any() else 0.0
    if other > AGREEMENT.turned * share:
        facts = f"{share:.0%} of the masks fit those of other views, {other:.0%} if they are turned by 180 degrees"
        step = "they must be of the photos as stored, not as EXIF turns them"
        return [Finding(where="masks", what=f"{facts}: {step}", level="error")]
    facts = f"only {share:.0%} of the masks fit those of other views, in most views"
    reasons = "leaves hide each other, or the masks are of other photos or of turned ones"
    return [Finding(where="masks", what=f"{facts}: {reasons}", level="warning")]


def turn_by_180(regions: Regions, cameras: Cameras) -> Regions:
    """The masks as they would be in photos that are turned by 180 degrees."""
    sizes = cameras.sizes[regions.view_index]
    low, high = sizes - regions.boxes[:, 2:], sizes - regions.boxes[:, :2]
    crops = [regions.crop(index).flatten().flip(0) for index in range(len(regions))]
    return replace(regions, boxes=torch.cat((low, high), 1), crops=torch.cat(crops) if crops else regions.crops)
