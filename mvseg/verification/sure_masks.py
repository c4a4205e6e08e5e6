"""Which of its own masks a detector may learn from: those that the other views confirm."""

from __future__ import annotations

import torch
from torch import Tensor

from mvseg.matching.result import Matching, count_sure_views
from mvseg.regions import Regions


def confirmed_masks(regions: Regions, matching: Matching, *, min_match_score: float, min_views: int) -> Tensor:
    """(D,) bool: the masks whose id is probably right and whose instance is surely seen in enough views.

    A false leaf hardly ever has masks in four views that fill each other's epipolar bands, and a piece of a leaf finds
    no partner of its outline. What is wrong in the same way in all views (a stem, the two halves of a leaf along its
    midrib) is confirmed, too: that the views cannot tell.

    Args:
        regions: D detections.
        matching: of these.
        min_match_score: least match score of a confirmed mask.
        min_views: least number of views with a match score of 0.5 or more; all V views where V is smaller.
    """
    views = count_sure_views(matching, regions.view_index)
    enough = views >= min(min_views, regions.num_views)
    is_matched = matching.instance_ids > 0
    of_instance = torch.cat((enough, enough.new_zeros(1)))[matching.instance_ids.clamp(min=0) - 1]
    return is_matched & of_instance & (matching.match_scores >= min_match_score)
