"""Match, assign, suppress, repeat (Sec. 3.2)."""

from __future__ import annotations

import warnings
from functools import partial

import torch
from torch import Tensor

from mvseg.detection.assignment import EpipolarAssignment
from mvseg.detection.nms import cluster_aware_nms, confirmed
from mvseg.detection.proposals import Proposals
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.scene import Cameras


def match_proposals(
    proposals: Proposals,
    cameras: Cameras,
    *,
    num_iterations: int = 1,
    cluster_iou: float = 0.3,
    detections_per_view: int = 100,
    match: MatchConfig = MatchConfig(),
) -> Matching:
    """Match first, alternate assignment and NMS, then discard unconfirmed boxes (steps 2 to 4 of `MultiViewMaskRCNN`).

    Args:
        proposals: the excessive set of all V views.
        cameras: V cameras on the same device.
        num_iterations: rounds of assignment and NMS.
        cluster_iou: NMS threshold; at first per view and class, then inside a cluster.
        detections_per_view: at most this many are kept in a view, best scores first.
        match: how regions are matched.

    Returns:
        The S proposals kept, best score first, matched; `labels` of their regions are those of the proposals. Warns of
        what `match_regions` says of it; what that said of earlier rounds is forgotten.
    """
    masks = proposals.as_masks()
    if not len(masks):
        return Matching(masks, MatchReport(match.resolved_method))
    assignment = EpipolarAssignment()
    per_class = torch.stack((masks.view_index, masks.classes), 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        keep = _suppress(proposals, per_class, cluster_iou, detections_per_view=detections_per_view)
        matching = match_masks(masks.select(keep), cameras, match)
        rematch = partial(
            match_masks,
            cameras=cameras,
            config=match,
            num_instances=_count_instances(matching.masks) if match.resolved_method == "symnmf" else {},
            residual_px=matching.residual_px,  # of the poses, which stay the same
        )
        for _ in range(num_iterations):
            matched = matching.masks
            ids, _ = assignment(
                proposals.regions, matched.regions, matched.instance_ids, cameras=cameras
            )
            groups = torch.cat((per_class, ids[:, None]), 1)
            keep = _suppress(proposals, groups, cluster_iou, detections_per_view=detections_per_view)
            caught.clear()
            matching = rematch(masks.select(keep))
        if num_iterations and matching.report.has_probabilities:
            stays = confirmed(
                proposals.boxes[keep],
                per_class[keep],
                matching.instance_ids,
                match_scores=matching.match_scores,
                iou_threshold=cluster_iou,
            )
            if not stays.all():
                caught.clear()
                matching = rematch(masks.select(keep[stays]))
    for each in caught:
        warnings.warn(each.message, stacklevel=2)
    return matching


def _count_instances(masks: Masks) -> dict[int, int]:
    """{class: number of its instances}."""
    of_class = {label: masks.instance_ids[masks.classes == label] for label in masks.classes.unique().tolist()}
    return {label: len(ids[ids > 0].unique()) for label, ids in of_class.items()}


def _suppress(proposals: Proposals, groups: Tensor, iou_threshold: float, *, detections_per_view: int) -> Tensor:
    """NMS by group, then the limit of detections per view, as torchvision has it."""
    keep = cluster_aware_nms(proposals.boxes, proposals.scores, groups, iou_threshold)
    view = proposals.regions.view_index[keep]
    earlier = (view[:, None] == view).tril(-1).sum(1)
    return keep[earlier < detections_per_view]
