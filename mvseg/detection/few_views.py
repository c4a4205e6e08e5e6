"""Leaves that too few photos show for the other views to verify them: left out, or kept as they were found.

Not in the paper.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.masks import Masks, Origin
from mvseg.verification.numbers import EVIDENCE


def select_by_views(masks: Masks, detected: Masks, *, min_views: int) -> Masks:
    """The verified masks of leaves that enough photos show.

    Args:
        masks: D verified masks on the CPU.
        detected: the D' masks that they come from, matched.
        min_views: in so many photos a leaf has a mask, at least. 2 leaves the masks as they are, since verification
            itself drops what one photo shows. With more, leaves in fewer photos go, and masks that are matched to
            nothing, but for the leaves and masks of a person. 1 adds detected masks that are matched to nothing, or to
            an instance that one or two photos show, unless other masks of their photo cover most of them (the better
            detection score first).

    Returns:
        The masks, ids as before, with gaps where instances went. Added ones follow, with `Origin.FEW_VIEWS`; their ids
        come after the others, one for each mask that was matched to nothing. Warns (InputWarning) of how many came.
    """
    if min_views > 2:
        leaves_of_a_person = masks.instance_ids[masks.is_corrected & (masks.instance_ids > 0)]
        is_his = masks.is_corrected | torch.isin(masks.instance_ids, leaves_of_a_person)
        return masks.select(is_his | (_count_views(masks) >= min_views))
    if min_views == 2:
        return masks
    added = _few(masks, detected.to("cpu"))
    if not len(added):
        return masks
    message = f"masks that one or two photos show and no other view verifies: {len(added)} (from_few_views)"
    warn(message)
    return Masks.concatenate((masks, added))


def _count_views(masks: Masks) -> Tensor:
    """(D,) int64: how many views show the instance of each mask; 0 for those that are matched to nothing."""
    seen = torch.zeros(masks.num_instances + 1, masks.regions.num_views, dtype=torch.bool)
    seen[masks.instance_ids.clamp(min=0), masks.view_index] = True
    seen[0] = False
    return seen.sum(1)[masks.instance_ids.clamp(min=0)]


def _few(masks: Masks, detected: Masks) -> Masks:
    """The detected masks that few views show and no verified mask covers, with ids from 1 on."""
    detected = detected.select((_count_views(detected) <= DETECTION.few_views) & (detected.origin == Origin.DETECTED))
    kept = []
    for view in range(masks.regions.num_views):
        own = (detected.view_index == view).nonzero()[:, 0]
        if not len(own):
            continue
        shown = masks.select(masks.view_index == view).regions
        right, bottom = torch.cat((shown.boxes, detected.regions.boxes[own]))[:, 2:].amax(0).tolist()
        taken = shown.label_map(view, torch.ones_like(shown.view_index), (right, bottom)) > 0
        for row in own[detected.detection_scores[own].argsort(descending=True, stable=True)].tolist():
            mask = detected.regions.mask(row, right, bottom)
            if int((mask & taken).sum()) <= EVIDENCE.shared * int(mask.sum()):
                kept.append(row)
                taken |= mask
    added = detected.select(torch.tensor(sorted(kept), dtype=torch.int64))
    alone = added.instance_ids < 1
    ids = added.instance_ids.clone()
    ids[alone] = added.num_instances + 1 + torch.arange(int(alone.sum()))
    origin = torch.full_like(ids, int(Origin.FEW_VIEWS))
    return replace(added, instance_ids=ids, origin=origin).with_merged(()).close_gaps()
