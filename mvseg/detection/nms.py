"""Non-maximum suppression that respects the clusters (Sec. 3.2)."""

from __future__ import annotations

import torch
import torchvision
from torch import Tensor

from mvseg.errors import InputError, check_arguments
from mvseg.masks import SURE


@check_arguments
def cluster_aware_nms(boxes: Tensor, scores: Tensor, groups: Tensor, iou_threshold: float = 0.3) -> Tensor:
    """Non-maximum suppression in which boxes of different groups never suppress each other.

    Args:
        boxes: (R, 4) xyxy.
        scores: (R,).
        groups: (R, G) or (R,) integers; two boxes are of one group when all G numbers agree (view, class and cluster).
        iou_threshold: a box is discarded when its IoU with a better one of its group exceeds this (the paper: 0.3).

    Returns:
        (S,) int64 indices of the boxes kept, best score first. The same as `torchvision.ops.nms` group by group.

    Raises:
        InputError: R differs between the arguments.
    """
    if not len(boxes) == len(scores) == len(groups):
        raise InputError(f"{len(boxes)} boxes with {len(scores)} scores and {len(groups)} groups, expected as many")
    if not len(boxes):
        return torch.zeros(0, dtype=torch.int64, device=boxes.device)
    _, group = groups.reshape(len(groups), -1).unique(dim=0, return_inverse=True)
    # batched_nms separates groups by offsets to the coordinates: in float32 a thousand groups would blur the boxes.
    return torchvision.ops.batched_nms(boxes.double(), scores.double(), group, iou_threshold)


def backed_by_views(
    boxes: Tensor,
    groups: Tensor,
    instance_ids: Tensor,
    *,
    match_scores: Tensor,
    iou_threshold: float = 0.3,
) -> Tensor:
    """Test which boxes stay: those that no better box overlaps, and those that the other views show to be another
    instance, by another id with a match score of at least 0.5.

    Cluster-aware NMS keeps a duplicate as well as a half-hidden leaf when it takes another cluster than the better box.
    Only the half-hidden leaf finds its match in the other views. Not in the paper.

    Args:
        boxes: (S, 4) xyxy, best score first.
        groups: (S, G) integers; only boxes of one group are compared (view and class).
        instance_ids: (S,) int64, -1 = matched to nothing.
        match_scores: (S,) probabilities that the ids are right.

    Returns:
        (S,) bool. A discarded box does not count as a better one for the rest.
    """
    _, group = groups.unique(dim=0, return_inverse=True)
    overlaps = (torchvision.ops.box_iou(boxes, boxes) > iou_threshold) & (group[:, None] == group)
    is_other = (instance_ids[:, None] != instance_ids) & ((instance_ids > 0) & (match_scores >= SURE))[:, None]
    rejects = (overlaps & ~is_other).tril(-1)
    stays = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    for box in rejects.any(1).nonzero()[:, 0].tolist():
        stays[box] = not bool((rejects[box] & stays).any())
    return stays
