"""A Mask R-CNN run on one photo at several scales: what it sees at most of them, it is surer of.

A leaf of 12 pixels is found in the enlarged photo, one of 500 in the reduced one. And where the detector errs, it errs
differently at each scale: the score of a mask becomes the mean, over the scales, of the best score of a mask that shows
the same there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN
from torchvision.models.detection.transform import GeneralizedRCNNTransform, resize_boxes
from torchvision.ops import batched_nms, box_iou

from mvseg.detectors.mask_cut import CUT
from mvseg.detectors.run import run_heads

LEAST_SCORE = 0.05  # what one scale is unsure of, the others may confirm
SAME_IOU = 0.5  # of two masks that show the same
NEAR_IOU = 0.25  # masks whose boxes overlap less are not compared
GRID = 28  # masks are compared on so many points squared
PAIRS_AT_ONCE = 4096  # 26 MB


def run_scales(
    model: GeneralizedRCNN,
    photo: Tensor,
    scales: Sequence[float],
    *,
    nms_thresh: float | None = None,
    detections_per_img: int | None = None,
) -> dict[str, Tensor]:
    """As `run_heads`, at several scales; at the one scale 1 it is that.

    Args:
        model: a torchvision Mask R-CNN in eval mode.
        photo: (3, H, W) float32 in [0, 1], on the model's device.
        scales: factors of the size that the model's transform gives to the photo.
        nms_thresh: IoU above which a box suppresses another; None for the model's own.
        detections_per_img: so many of the best scores are kept; None for the model's own.

    Returns:
        The D detections as from `run_heads`, best score first, in the frame of the model's transform. At several scales
        the model's threshold of scores is not applied: the boxes of each score 0.05 or more.
    """
    limits: dict[str, Any] = {"nms_thresh": nms_thresh, "detections_per_img": detections_per_img}
    if tuple(scales) == (1.0,):
        return run_heads(model, photo, **limits)
    frame = model.transform([photo])[0].image_sizes[0]
    sides = [round(scale * max(frame)) for scale in scales]
    looks = [look(model, photo, number, side=side, **limits) for number, side in enumerate(sides)]
    for found in looks:
        width, height = found.pop("frame").tolist()
        found["boxes"] = resize_boxes(found["boxes"], [height, width], list(frame))
    together = {key: torch.cat([found[key] for found in looks]) for key in looks[0]}
    scores = agree(together, num_scales=len(scales))
    order = (scores + 1e-6 * together["scores"]).argsort()  # of masks that agree, the surest comes first
    rank = order.argsort().to(together["boxes"].dtype)
    threshold = model.roi_heads.nms_thresh if nms_thresh is None else nms_thresh
    kept = batched_nms(together["boxes"], rank, together["labels"], threshold)
    kept = kept[: model.roi_heads.detections_per_img if detections_per_img is None else detections_per_img]
    together["scores"] = scores.to(together["scores"].dtype)
    kept_of = {key: together[key][kept] for key in ("boxes", "labels", "scores", "masks")}
    return kept_of | {"frame": torch.tensor([frame[1], frame[0]])}


def look(model: GeneralizedRCNN, photo: Tensor, number: int, *, side: int, **limits: Any) -> dict[str, Tensor]:
    """The detections of one scale, as from `run_heads`.

    Args:
        model, photo: as for `run_scales`.
        number: of the scale, from 0 on.
        side: longer side of the scaled photo, pixels.
        limits: for `run_heads`.

    Returns:
        Also "scale" (D,), the number; and "is_plain" (D,) bool, those that may speak for detections of another scale:
        the survivors of plain NMS. (Of the many that a large threshold leaves, some one agrees with anything.)
    """
    own = model.transform
    transform = GeneralizedRCNNTransform(max(1, side), max(1, side), own.image_mean, own.image_std, own.size_divisible)
    found = run_heads(model, photo, **limits, transform=transform, score_thresh=LEAST_SCORE)
    plain = batched_nms(found["boxes"], found["scores"], found["labels"], model.roi_heads.nms_thresh)
    is_plain = torch.zeros_like(found["labels"], dtype=torch.bool).index_fill_(0, plain, True)
    return found | {"scale": torch.full_like(found["labels"], number), "is_plain": is_plain}


def agree(detections: dict[str, Tensor], *, num_scales: int) -> Tensor:
    """The scores of detections once the other scales have been asked.

    Args:
        detections: N of all scales, as from `look`, in one frame.
        num_scales: of which none may have found anything.

    Returns:
        (N,) float64, the mean, over the scales, of the best score among plain ones of the same class with an IoU above
        0.5; 0 for a scale without any, and the detection's own score for its own scale.
    """
    scores, labels, scale = detections["scores"].double(), detections["labels"], detections["scale"]
    best = scores.new_zeros((len(scores), num_scales))
    best[torch.arange(len(scores)), scale] = scores
    is_near = box_iou(detections["boxes"], detections["boxes"]) > NEAR_IOU
    is_near &= (scale[:, None] != scale) & (labels[:, None] == labels) & detections["is_plain"]
    pairs = is_near.nonzero()
    detection, plain = pairs[mask_iou(detections["boxes"], detections["masks"], pairs) > SAME_IOU].T
    best.view(-1).scatter_reduce_(0, detection * num_scales + scale[plain], scores[plain], "amax")
    return best.mean(1)


def mask_iou(boxes: Tensor, masks: Tensor, pairs: Tensor) -> Tensor:
    """(P,) IoU of pairs of masks, sampled on a grid over both of their boxes.

    Args:
        boxes: (N, 4) xyxy.
        masks: (N, 1, S, S) probabilities in the frame of the boxes.
        pairs: (P, 2) int64.
    """
    return torch.cat([_mask_iou(boxes, masks, part) for part in pairs.split(PAIRS_AT_ONCE)])


def _mask_iou(boxes: Tensor, masks: Tensor, pairs: Tensor) -> Tensor:
    corners = boxes[pairs]  # (P, 2, 4)
    low, high = corners[..., :2].amin(1), corners[..., 2:].amax(1)
    steps = (torch.arange(GRID, device=boxes.device) + 0.5) / GRID
    inside = []
    for side in range(2):
        start, size = corners[:, side, :2], (corners[:, side, 2:] - corners[:, side, :2]).clamp(min=1e-6)
        at = (low + (high - low) * steps[:, None, None] - start) / size * 2 - 1  # (GRID, P, 2): x and y of its box
        columns, rows = at[..., 0].T, at[..., 1].T
        grid = torch.stack(torch.broadcast_tensors(columns[:, None, :], rows[:, :, None]), 3)
        inside.append(torch.nn.functional.grid_sample(masks[pairs[:, side]], grid, align_corners=False)[:, 0] > CUT)
    first, second = inside
    return (first & second).sum((1, 2)) / (first | second).sum((1, 2)).clamp(min=1)
