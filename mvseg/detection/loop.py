"""Match, assign, suppress, repeat (Sec. 3.2)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import torch
from torch import Tensor

from mvseg.detection.assignment import EpipolarAssignment
from mvseg.detection.nms import cluster_aware_nms, confirmed
from mvseg.detection.proposals import Proposals
from mvseg.masks import Masks, Origin
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
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
    progress: bool = False,
) -> Matching:
    """Match first, alternate assignment and NMS, then discard unconfirmed boxes (steps 2 to 4 of `MultiViewMaskRCNN`).

    Args:
        proposals: the excessive set of all V views.
        cameras: V cameras on the same device.
        num_iterations: rounds of assignment and NMS.
        cluster_iou: NMS threshold; at first per view and class, then inside a cluster.
        detections_per_view: at most this many are kept in a view, best scores first.
        match: how regions are matched.
        progress: show progress bars.

    Returns:
        The S proposals kept, best score first, matched; `labels` of their regions are those of the proposals. Warns of
        what `match_regions` says of it; what that said of earlier rounds is forgotten.
    """
    assignment = EpipolarAssignment()
    per_class = torch.stack((proposals.regions.view_index, proposals.classes), 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        keep = _suppress(proposals, per_class, cluster_iou, detections_per_view=detections_per_view)
        matching, num_instances = _match_classes(proposals.select(keep), cameras, match, progress=progress)
        if match.resolved_method != "symnmf":
            num_instances = {}
        residual_px = matching.residual_px  # of the poses, which stay the same

        def rematch(kept: Tensor) -> Matching:
            caught.clear()
            return _match_classes(
                proposals.select(kept),
                cameras,
                match,
                num_instances=num_instances,
                residual_px=residual_px,
                progress=progress,
            )[0]

        for _ in range(num_iterations):
            matched = matching.masks
            ids, _ = assignment(
                proposals.regions, matched.regions, matched.instance_ids, cameras=cameras, progress=progress
            )
            groups = torch.cat((per_class, ids[:, None]), 1)
            keep = _suppress(proposals, groups, cluster_iou, detections_per_view=detections_per_view)
            matching = rematch(keep)
        if num_iterations and matching.report.has_probabilities:
            stays = confirmed(
                proposals.boxes[keep],
                per_class[keep],
                matching.instance_ids,
                match_scores=matching.match_scores,
                iou_threshold=cluster_iou,
            )
            if not stays.all():
                matching = rematch(keep[stays])
    for each in caught:
        warnings.warn(each.message, stacklevel=2)
    return matching


def _suppress(
    proposals: Proposals, groups: Tensor, iou_threshold: float, *, detections_per_view: int
) -> Tensor:
    """NMS by group, then the limit of detections per view, as torchvision has it."""
    keep = cluster_aware_nms(proposals.boxes, proposals.scores, groups, iou_threshold)
    view = proposals.regions.view_index[keep]
    earlier = (view[:, None] == view).tril(-1).sum(1)
    return keep[earlier < detections_per_view]


def _match_classes(
    proposals: Proposals,
    cameras: Cameras,
    match: MatchConfig,
    *,
    num_instances: Mapping[int, int] = MappingProxyType({}),
    residual_px: int | None = None,
    progress: bool = False,
) -> tuple[Matching, dict[int, int]]:
    """Match proposals class by class; instances of different classes get different ids.

    `num_instances` maps classes to their numbers of instances; those of the other classes are estimated.
    For `residual_px` see `match_regions`. Returns the matching and the number of instances of each
    class.
    """
    parts, indices, counts = [], [], {}
    for label in proposals.classes.unique().tolist():
        members = (proposals.classes == label).nonzero()[:, 0]
        config = replace(match, num_instances=num_instances.get(label) or match.num_instances)
        part = match_regions(
            proposals.regions.select(members), cameras, config, residual_px=residual_px, progress=progress
        )
        parts.append(part)
        indices.append(members)
        counts[label] = parts[-1].num_instances
    if not parts:
        return Matching(Masks.of(proposals.regions, origin=Origin.DETECTED), MatchReport(match.resolved_method)), counts
    order = torch.cat(indices).argsort()
    joined = Masks.concatenate([part.masks for part in parts]).select(order)
    masks = replace(
        joined,
        detection_scores=proposals.scores,
        classes=proposals.classes,
        origin=torch.full_like(proposals.classes, Origin.DETECTED),
    )
    report = MatchReport.join(
        [part.report for part in parts], [int((part.instance_ids > 0).sum()) for part in parts]
    )
    if len({part.method for part in parts}) > 1:
        report = replace(report, method=match.resolved_method)
    return Matching(masks, report), counts
