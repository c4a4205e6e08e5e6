"""Cutting masks that cover two instances in two."""

from __future__ import annotations

from dataclasses import replace

import torch

from mvseg.masks import Masks, replace_crops
from mvseg.regions import mask_box


def split_merged(masks: Masks) -> Masks:
    """Cut each mask that shows two instances in two, one part per instance.

    Args:
        masks: D masks, of which `second_parts` tells what shows a second instance.

    Returns:
        D' >= D masks on the same device and in the same order, the second part of a mask right after the first. Both
        have its scores; none shows two instances any more. A mask stays whole if one part would be empty, or if a
        person corrected it.
    """
    masks = masks.with_merged([each for each in masks.merged if not masks.is_corrected[each.region]])
    rows, boxes, crops, ids = [], [], [], []
    columns = zip(masks.instance_ids.tolist(), masks.second_ids.tolist(), masks.regions.boxes.tolist(), strict=True)
    for row, (own_id, other_id, box) in enumerate(columns):
        crop, second = masks.regions.crop(row).cpu(), masks.second_parts[row]
        parts = [(own_id, crop)]
        if second is not None and (second & crop).any() and (crop & ~second).any():
            parts = [(own_id, crop & ~second), (other_id, second & crop)]
        for instance, part in parts:
            x1, y1, x2, y2 = mask_box(part) if len(parts) > 1 else (0, 0, crop.shape[1], crop.shape[0])
            rows.append(row)
            boxes.append((box[0] + x1, box[1] + y1, box[0] + x2, box[1] + y2))
            crops.append(part[y1:y2, x1:x2])
            ids.append(instance)
    repeated = masks.select(torch.tensor(rows, dtype=torch.int64, device=masks.regions.device)).with_merged(())
    cut = replace_crops(repeated, boxes, crops)
    return replace(cut, instance_ids=torch.tensor(ids, dtype=torch.int64)).to(masks.regions.device)
