"""Match, assign, suppress, repeat (Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from mvseg.detection.assignment import EpipolarAssignment
from mvseg.detection.nms import backed_by_views, cluster_aware_nms
from mvseg.errors import collect_warnings, warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.scene import Cameras


def match_proposals(
    proposals: Masks,
    cameras: Cameras,
    *,
    boxes: Tensor | None = None,
    num_iterations: int = 1,
    cluster_iou: float = 0.3,
    detections_per_view: int = 100,
    match: MatchConfig = MatchConfig(),
    residual_px: int | None = None,
) -> Matching:
    """Match first, alternate assignment and NMS, then discard boxes that no other view backs: steps 2 to 4 of
    `MultiViewMaskRCNN`.

    Args:
        proposals: R scored masks of V views, the excessive set; objects of different classes are never matched.
        boxes: (R, 4) float32 xyxy for NMS; None: those of the masks.
        cluster_iou: NMS threshold; at first per view and class, then inside a cluster.
        detections_per_view: max. number, best scores first.
        residual_px: the reprojection error, where an earlier matching with these cameras has found it; None: estimated.

    Returns:
        The S proposals kept, best score first, matched; `labels` of their regions are those of the proposals. Warns as
        the last `match_masks` does.
    """
    if not len(proposals):
        return Matching(proposals, MatchReport(match.resolved_method))
    assignment = EpipolarAssignment()
    boxes = proposals.regions.boxes.float() if boxes is None else boxes
    suppress = partial(_suppress, proposals, boxes, cluster_iou, detections_per_view=detections_per_view)
    per_class = torch.stack((proposals.view_index, proposals.classes), 1)

    def match_some(rows: Tensor, residual_px: int | None, counts: Mapping[int, int]) -> tuple[Matching, list[Finding]]:
        chosen = proposals.select(rows)
        with collect_warnings() as findings:
            return match_masks(chosen, cameras, match, num_instances=counts, residual_px=residual_px), findings

    keep = suppress(per_class)
    matching, findings = match_some(keep, residual_px, {})
    counts = _count_instances(matching.masks) if match.resolved_method == "symnmf" else {}
    residual_px = matching.report.residual_px  # of the poses, which stay the same
    for _ in range(num_iterations):
        matched = matching.masks
        ids, _ = assignment(proposals.regions, matched.regions, matched.instance_ids, cameras=cameras)
        keep = suppress(torch.cat((per_class, ids[:, None]), 1))
        matching, findings = match_some(keep, residual_px, counts)
    if num_iterations and matching.report.has_probabilities:
        ids, scores = matching.instance_ids, matching.match_scores
        stays = backed_by_views(boxes[keep], per_class[keep], ids, match_scores=scores, iou_threshold=cluster_iou)
        if not stays.all():
            matching, findings = match_some(keep[stays], residual_px, counts)
    for each in findings:
        warn(each)
    return matching


def _count_instances(masks: Masks) -> dict[int, int]:
    of_class = {label: masks.instance_ids[masks.classes == label] for label in masks.classes.unique().tolist()}
    return {label: len(ids[ids > 0].unique()) for label, ids in of_class.items()}


def _suppress(
    proposals: Masks, boxes: Tensor, iou_threshold: float, groups: Tensor, *, detections_per_view: int
) -> Tensor:
    keep = cluster_aware_nms(boxes, proposals.detection_scores, groups, iou_threshold)
    view = proposals.view_index[keep]
    earlier = (view[:, None] == view).tril(-1).sum(1)
    return keep[earlier < detections_per_view]
