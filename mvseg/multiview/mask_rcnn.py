"""Stage 7: a torchvision Mask R-CNN that sees all views of a scene at once (Sec. 3.2)."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN
from torchvision.models.detection.roi_heads import expand_boxes, expand_masks, paste_mask_in_image
from torchvision.models.detection.transform import resize_boxes

from mvseg.config import MatchConfig
from mvseg.detectors.mask_cut import CUT, decide_masks
from mvseg.errors import InputError
from mvseg.matching.match_regions import Matching, choose_method, match_regions
from mvseg.multiview.nms import EpipolarAssignment, cluster_aware_nms, confirmed
from mvseg.regions import Regions, stack_regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Proposals:
    """R scored masks of V views, many of them of the same thing.

    Attributes:
        regions: the R masks as box crops, in the frame of the images.
        boxes: (R, 4) float32 xyxy in the frame of the images; what NMS compares.
        scores: (R,) float32.
        classes: (R,) int64; things of different classes are never matched.
    """

    regions: Regions
    boxes: Tensor
    scores: Tensor
    classes: Tensor

    def select(self, index: Tensor) -> Proposals:
        """The proposals at an int64 index, in that order."""
        return Proposals(self.regions.select(index), self.boxes[index], self.scores[index], self.classes[index])


class MultiViewMaskRCNN(GeneralizedRCNN):  # type: ignore[misc]  # torchvision carries no types
    """Wraps any torchvision Mask R-CNN; same modules, same state dict, and ids across views when told the cameras.

    In train mode, and in eval mode without cameras, it is the detector it wraps. With cameras, in eval mode:

    1. Each view's proposals pass the box and mask heads and NMS with a large threshold (`proposal_iou`, the paper:
       0.7): an excessive set of masks. Each mask is cut where its expected IoU is largest, and its score multiplied by
       that (`mvseg.detectors.mask_cut`); what then scores less than the detector's `roi_heads.score_thresh` goes.
    2. Match first: what plain NMS at `cluster_iou` leaves of it is matched across views. Things of different classes
       are never matched.
    3. Alternate `num_iterations` times: every mask of the excessive set takes the cluster whose epipolar map it
       resembles most (Eq. 5); NMS with a small threshold (`cluster_iou`, 0.3) inside each cluster; match the survivors
       again. Masks that resemble no map form one more group.
    4. Where match scores are chances (`match` names no other method than "nview"): a box that overlaps a better one
       stays only if the other views are sure that it is something else (`confirmed`); match what is left.

    Departures from the paper: it matches the excessive set itself at first, and estimates |k| anew each time; here,
    where `match` names "symnmf", |k| is that of the first match. The duplicates in the other sets inflate the number of
    masks per view, from which the search range of |k| follows; that splits leaves, and the pieces then shelter
    duplicates from NMS. The other methods of matching need no |k|.

    Args:
        detector: a torchvision Mask R-CNN (any builder, any backbone, or `MaskRCNN` itself). Its modules are shared,
            not copied.
        num_iterations: of assignment and NMS; 0 only matches what the detector finds.
        proposal_iou: NMS threshold of the excessive set.
        cluster_iou: NMS threshold inside a cluster, and of the set that is matched first.
        proposals_per_view: size of the excessive set; the best scores stay.
        match: how regions are matched; a given number of instances holds for each class.

    Raises:
        InputError: the detector has no mask head.
    """

    def __init__(
        self,
        detector: MaskRCNN,
        *,
        num_iterations: int = 1,
        proposal_iou: float = 0.7,
        cluster_iou: float = 0.3,
        proposals_per_view: int = 300,
        match: MatchConfig | None = None,
    ) -> None:
        if not (isinstance(detector, GeneralizedRCNN) and detector.roi_heads.has_mask()):
            raise InputError(f"{type(detector).__name__} has no mask head, expected a torchvision Mask R-CNN")
        super().__init__(detector.backbone, detector.rpn, detector.roi_heads, detector.transform)
        self.assignment = EpipolarAssignment()
        self.num_iterations = num_iterations
        self.proposal_iou = proposal_iou
        self.cluster_iou = cluster_iou
        self.proposals_per_view = proposals_per_view
        self.match = match
        self.train(detector.training)

    def forward(
        self,
        images: list[Tensor],
        targets: list[dict[str, Tensor]] | None = None,
        *,
        cameras: Cameras | None = None,
    ) -> dict[str, Tensor] | list[dict[str, Tensor]]:
        """Detect, and match across views.

        Args:
            images: V tensors (3, H, W) in [0, 1], all of one scene when cameras are given; sizes may differ.
            targets: in train mode, as torchvision's detectors take them.
            cameras: the V undistorted cameras of the images; ignored in train mode.

        Returns:
            In train mode the detector's losses. In eval mode V dicts with `boxes`, `labels`, `scores`, `masks`, which
            are to be cut at 0.5; with cameras also `instance_ids` (int64, the same number for the same instance in
            every view, -1 = matched to nothing) and `match_scores` (float32 in [0, 1], see `Matching`).

        Raises:
            InputError: two or more images are expected, as many cameras, and the cameras' sizes.
        """
        if self.training or cameras is None:
            return super().forward(images, targets)
        sizes = [[image.shape[-1], image.shape[-2]] for image in images]
        _check_cameras(cameras, sizes)
        with torch.no_grad():
            found = [self._propose(image) for image in images]
        # Counts of pixels need single precision, too.
        with torch.no_grad(), torch.autocast(images[0].device.type, enabled=False):
            proposals = gather_proposals(found, sizes)
            keep, matching = self._match(proposals, cameras.to(images[0].device))
            return self._collect(found, sizes, proposals.regions.view_index, keep, matching)

    @torch.no_grad()
    def find_regions(self, images: Iterable[Tensor], cameras: Cameras) -> tuple[Proposals, Matching]:
        """As `forward` with cameras in eval mode, for large scenes: one image in memory at a time, masks as crops.

        Args:
            images: V tensors (3, H, W) in [0, 1] on the detector's device, e.g. from a generator.
            cameras: their V undistorted cameras.

        Returns:
            The D detections that are kept, on the CPU, ordered by view and by falling score, and their matching.

        Raises:
            InputError: as `forward`.
        """
        found, sizes = [], []
        for image in images:
            found.append({key: value.cpu() for key, value in self._propose(image).items()})
            sizes.append([image.shape[-1], image.shape[-2]])
        _check_cameras(cameras, sizes)
        with torch.autocast("cpu", enabled=False):
            proposals = gather_proposals(found, sizes)
            keep, matching = self._match(proposals, cameras.to("cpu"))
        order = proposals.regions.view_index[keep].argsort(stable=True)
        kept = proposals.select(keep[order])
        ids, scores, merged = matching.instance_ids[order], matching.match_scores[order], matching.merged.clone()
        merged[:, 0] = order.argsort()[merged[:, 0]]
        return kept, replace(matching, instance_ids=ids, match_scores=scores, merged=merged)

    def _match(self, proposals: Proposals, cameras: Cameras) -> tuple[Tensor, Matching]:
        """Indices of the proposals to keep, without those whose mask is empty, and their matching."""
        solid = (proposals.regions.areas > 0).nonzero()[:, 0]
        keep, matching = match_proposals(
            proposals.select(solid),
            cameras,
            num_iterations=self.num_iterations,
            cluster_iou=self.cluster_iou,
            detections_per_view=self.roi_heads.detections_per_img,
            assignment=self.assignment,
            match=self.match,
        )
        return solid[keep], matching

    def _propose(self, image: Tensor) -> dict[str, Tensor]:
        """One view's excessive set: torchvision's own heads with a larger NMS threshold; in the transform's frame."""
        resized, _ = self.transform([image])
        features = self.backbone(resized.tensors)
        if isinstance(features, Tensor):
            features = OrderedDict([("0", features)])
        lenient = copy.copy(self.roi_heads)  # shares the weights; the detector's own thresholds stay as they are
        lenient.nms_thresh, lenient.detections_per_img = self.proposal_iou, self.proposals_per_view
        # Under autocast the backbone may work in half precision; the coordinates of boxes may not.
        with torch.autocast(image.device.type, enabled=False):
            kind = next(self.roi_heads.parameters()).dtype
            features = OrderedDict((level, map_.to(kind)) for level, map_ in features.items())
            boxes, _ = self.rpn(resized, features)
            (found,), _ = lenient(features, boxes, resized.image_sizes)
        height, width = resized.image_sizes[0]
        found = decide_masks(found | {key: found[key].float() for key in ("boxes", "scores", "masks")})
        good = found["scores"] >= self.roi_heads.score_thresh
        return {key: value[good] for key, value in found.items()} | {"frame": torch.tensor([width, height])}

    def _collect(
        self,
        found: list[dict[str, Tensor]],
        sizes: list[list[int]],
        view_index: Tensor,
        keep: Tensor,
        matching: Matching,
    ) -> list[dict[str, Tensor]]:
        """torchvision's result dicts of the kept proposals, with their ids."""
        results = []
        start = 0
        for view, (one, (width, height)) in enumerate(zip(found, sizes, strict=True)):
            here = view_index[keep] == view
            index = keep[here] - start
            kept = {key: one[key][index] for key in ("boxes", "labels", "scores", "masks")}
            frame_width, frame_height = one["frame"].tolist()
            (result,) = self.transform.postprocess([kept], [(frame_height, frame_width)], [(height, width)])
            result |= {"instance_ids": matching.instance_ids[here], "match_scores": matching.match_scores[here]}
            results.append(result)
            start += len(one["boxes"])
        return results


def _check_cameras(cameras: Cameras, sizes: list[list[int]]) -> None:
    if not isinstance(cameras, Cameras):
        raise InputError(f"cameras is a {type(cameras).__name__}, expected Cameras (of a scene: scene.cameras)")
    if len(sizes) < 2 or len(sizes) != len(cameras):
        raise InputError(f"{len(sizes)} images with {len(cameras)} cameras, expected as many, two or more")
    for view, (found, told) in enumerate(zip(sizes, cameras.sizes.tolist(), strict=True)):
        if found != told:
            raise InputError(f"image {view} is {found[0]} x {found[1]}, its camera says {told[0]} x {told[1]}")


def match_proposals(
    proposals: Proposals,
    cameras: Cameras,
    *,
    num_iterations: int = 1,
    cluster_iou: float = 0.3,
    detections_per_view: int = 100,
    assignment: EpipolarAssignment | None = None,
    match: MatchConfig | None = None,
) -> tuple[Tensor, Matching]:
    """Match first, alternate assignment and NMS, and ask the other views (steps 2 to 4 of `MultiViewMaskRCNN`).

    Args:
        proposals: the excessive set of all V views.
        cameras: V cameras on the same device.
        num_iterations: of assignment and NMS.
        cluster_iou: NMS threshold; at first per view and class, then inside a cluster.
        detections_per_view: the best scores stay.
        assignment: None for a default one.
        match: how regions are matched.

    Returns:
        (S,) int64 indices of the proposals kept, best score first, and their matching.
    """
    assignment = assignment or EpipolarAssignment()
    per_class = torch.stack((proposals.regions.view_index, proposals.classes), 1)
    keep = _suppress(proposals, per_class, cluster_iou, detections_per_view)
    matching, counts = _match_classes(proposals, keep, cameras, match, {})
    for _ in range(num_iterations):
        regions = proposals.regions.select(keep)
        clusters, _ = assignment(proposals.regions, regions, matching.instance_ids, cameras)
        groups = torch.cat((per_class, clusters[:, None]), 1)
        keep = _suppress(proposals, groups, cluster_iou, detections_per_view)
        matching, _ = _match_classes(proposals, keep, cameras, match, counts)
    if num_iterations and matching.support is not None:
        ids, scores = matching.instance_ids, matching.match_scores
        stays = confirmed(proposals.boxes[keep], per_class[keep], ids, scores, iou_threshold=cluster_iou)
        if not stays.all():
            keep = keep[stays]
            matching, _ = _match_classes(proposals, keep, cameras, match, counts)
    return keep, matching


def _suppress(proposals: Proposals, groups: Tensor, iou_threshold: float, detections_per_view: int) -> Tensor:
    """NMS by group, then the limit of detections per view, as torchvision has it."""
    keep = cluster_aware_nms(proposals.boxes, proposals.scores, groups, iou_threshold)
    view = proposals.regions.view_index[keep]
    earlier = (view[:, None] == view).tril(-1).sum(1)
    return keep[earlier < detections_per_view]


def _match_classes(
    proposals: Proposals, keep: Tensor, cameras: Cameras, match: MatchConfig | None, counts: dict[int, int]
) -> tuple[Matching, dict[int, int]]:
    """Match the kept proposals class by class; instances of different classes get different ids.

    Returns the matching and {class: number of instances}; with "symnmf", classes in `counts` get that number instead
    of a search.
    """
    regions, classes = proposals.regions.select(keep), proposals.classes[keep]
    ids = torch.full_like(classes, -1)
    scores = torch.zeros_like(proposals.scores[keep])
    found: dict[int, int] = {}
    parts = []
    for one_class in classes.unique().tolist():
        members = classes == one_class
        config = match or MatchConfig()
        if counts.get(one_class) and choose_method(config) == "symnmf":
            config = replace(config, num_instances=counts[one_class])
        matching = match_regions(regions.select(members), cameras, config)
        first = sum(found.values())
        ids[members] = torch.where(matching.instance_ids >= 0, matching.instance_ids + first, -1)
        scores[members] = matching.match_scores
        places, merged = members.nonzero()[:, 0], matching.merged
        merged = torch.stack((places[merged[:, 0]], merged[:, 1] + first, merged[:, 2] + first), 1)
        parts.append(replace(matching, merged=merged))
        found[one_class] = matching.num_instances
    return _join_matchings(parts, ids, scores, choose_method(match or MatchConfig())), found


def _join_matchings(parts: list[Matching], ids: Tensor, scores: Tensor, method: str) -> Matching:
    """What is known of the instances of all classes, class after class; the largest residual."""
    if not parts:
        return Matching(ids, scores, 0, method)
    supports = [part.support for part in parts if part.support is not None]
    return Matching(
        ids,
        scores,
        sum(part.num_instances for part in parts),
        parts[0].method if len({part.method for part in parts}) == 1 else method,
        torch.cat(supports) if len(supports) == len(parts) else None,
        torch.cat([part.merged for part in parts]),
        max((part.residual_px for part in parts if part.residual_px is not None), default=None),
        tuple(crop for part in parts for crop in part.merged_parts),
    )


def gather_proposals(found: list[dict[str, Tensor]], sizes: list[list[int]]) -> Proposals:
    """Proposals of all views, moved to the frame of the images; masks become box crops, never full frames.

    Args:
        found: per view `boxes` (R_v, 4), `scores`, `labels`, `masks` (R_v, 1, S, S) probabilities, and `frame`, the
            width and height that the boxes refer to.
        sizes: per view the width and height of the image.

    Returns:
        The proposals, view after view. The crops hold the very pixels that torchvision pastes, where they exceed 0.5.
    """
    boxes, view_index, windows, crops = [], [], [], []
    for view, (one, (width, height)) in enumerate(zip(found, sizes, strict=True)):
        frame_width, frame_height = one["frame"].tolist()
        scaled = resize_boxes(one["boxes"], [frame_height, frame_width], [height, width])
        masks, scale = expand_masks(one["masks"], padding=1)
        for mask, pasted in zip(masks[:, 0], expand_boxes(scaled, scale).to(torch.int64), strict=True):
            x1, y1 = pasted[:2].clamp(min=0).tolist()
            x2, y2 = min(int(pasted[2]) + 1, width), min(int(pasted[3]) + 1, height)
            local = pasted - torch.tensor([x1, y1, x1, y1], device=pasted.device)
            crops.append((paste_mask_in_image(mask, local, y2 - y1, x2 - x1) > CUT).flatten())
            windows.append((x1, y1, x2, y2))
        boxes.append(scaled)
        view_index += [view] * len(scaled)
    device = boxes[0].device
    numbers = list(range(len(crops)))
    regions = stack_regions(view_index, windows, [crop.cpu() for crop in crops], numbers, len(sizes)).to(device)
    scores, classes = (torch.cat([one[key] for one in found]) for key in ("scores", "labels"))
    return Proposals(regions, torch.cat(boxes), scores, classes)
