"""Cutting masks that cover two instances in two."""

from __future__ import annotations

from dataclasses import replace

import torch

from mvseg.crop import Crop
from mvseg.errors import check_arguments
from mvseg.masks import Masks, replace_crops


@check_arguments
def split_merged(masks: Masks) -> Masks:
    """Cut each mask that shows two instances in two, one part per instance.

    Args:
        masks: D masks; `second_parts` are the pixels that show a second instance.

    Returns:
        D' >= D masks on the same device and in the same order, the second part of a mask right after the first. Both
        have its scores; none shows two instances any more. A mask stays whole if one part would be empty, or if
        the user corrected it.
    """
    masks = masks.with_merged([each for each in masks.merged if not masks.is_corrected[each.region]])
    device, masks = masks.regions.device, masks.to("cpu")
    rows, crops, ids = [], [], []
    for row, (own, other) in enumerate(zip(masks.instance_ids.tolist(), masks.second_ids.tolist(), strict=True)):
        whole, second = masks.regions.placed(row), masks.second_parts[row]
        parts = [(own, whole)]
        if second is not None and (second & whole.pixels).any() and (whole.pixels & ~second).any():
            pairs = (own, whole.pixels & ~second), (other, whole.pixels & second)
            parts = [(instance, Crop(whole.box, part).tighten()) for instance, part in pairs]
        for instance, part in parts:
            rows.append(row)
            crops.append(part)
            ids.append(instance)
    cut = replace_crops(masks.select(torch.tensor(rows, dtype=torch.int64)).with_merged(()), crops)
    return replace(cut, instance_ids=torch.tensor(ids, dtype=torch.int64)).to(device)
