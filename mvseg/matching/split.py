"""Cutting masks that cover two instances in two."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvseg.matching.result import Matching
from mvseg.regions import Regions, mask_box, stack_regions


def split_merged(regions: Regions, matching: Matching) -> tuple[Regions, Matching, Tensor]:
    """Cut each mask that covers two instances in two, one part per instance.

    Args:
        regions: the D regions that were matched.
        matching: their matching.

    Returns:
        D' >= D regions in the same order, the second part of a mask right after the first. Their matching: both parts
        keep the mask's match score, the support is unchanged, `merged` is empty. And (D',) int64, the region that each
        comes from. A mask stays whole if one part would be empty.
    """
    merged = {mask.region: mask for mask in matching.merged}
    source, boxes, crops, ids = [], [], [], []
    for region, (own_id, box) in enumerate(zip(matching.instance_ids.tolist(), regions.boxes.tolist(), strict=True)):
        crop = regions.crop(region)
        parts = [(own_id, crop)]
        if region in merged:
            second = merged[region].part.to(crop.device) & crop
            halves = [(own_id, crop & ~second), (merged[region].other, second)]
            parts = halves if all(bool(half.any()) for _, half in halves) else parts
        for instance, part in parts:
            x1, y1, x2, y2 = mask_box(part) if len(parts) > 1 else (0, 0, crop.shape[1], crop.shape[0])
            source.append(region)
            boxes.append((box[0] + x1, box[1] + y1, box[0] + x2, box[1] + y2))
            crops.append(part[y1:y2, x1:x2].flatten().cpu())
            ids.append(instance)
    index = torch.tensor(source, dtype=torch.int64, device=regions.device)
    views, labels = regions.view_index[index].tolist(), regions.labels[index].tolist()
    cut = stack_regions(views, boxes, crops, labels=labels, num_views=regions.num_views)
    matched = replace(
        matching,
        instance_ids=torch.tensor(ids, dtype=torch.int64, device=regions.device),
        match_scores=matching.match_scores[index],
        merged=(),
    )
    return cut.to(regions.device), matched, index
