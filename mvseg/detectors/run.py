"""A Mask R-CNN run on one photo, step by step: torchvision's own forward pass, unrolled.

torchvision pastes all masks into full frames at once (100 detections in a photo of 24 megapixels take some 30 GB), and
under autocast computes boxes in half precision, too. Here masks stay small until they are asked for, one at a time, and
autocast ends behind the backbone.
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN
from torchvision.models.detection.roi_heads import maskrcnn_inference, paste_masks_in_image
from torchvision.models.detection.transform import GeneralizedRCNNTransform, resize_boxes
from torchvision.ops import batched_nms, clip_boxes_to_image

from mvseg.detectors.mask_cut import CUT, decide_masks

GROWTH = 0.15  # chosen: part of a side that a mask touches, from which the side moves out; and how far, in box spans


def run_heads(
    model: GeneralizedRCNN,
    photo: Tensor,
    *,
    nms_thresh: float | None = None,
    detections_per_img: int | None = None,
    num_growths: int = 0,
    image_size: int | None = None,
) -> dict[str, Tensor]:
    """Run the heads of a detector on one photo, before anything is scaled back to the photo. Under autocast the
    backbone may work in half precision; the coordinates of boxes may not, so that everything behind it runs in the
    precision of the heads' weights.

    Args:
        model: a torchvision Mask R-CNN in eval mode.
        photo: (3, H, W) float32 in [0, 1], on the model's device.
        nms_thresh: IoU above which a box suppresses another; None for the model's own.
        detections_per_img: so many of the best scores are kept; None for the model's own.
        num_growths: how often boxes grow where masks touch their sides, see `grow_boxes`; those that score less than
            the model's threshold, once masks are cut, are gone then.
        image_size: longer side, pixels, that the photo is scaled to; None: as the model does.

    Returns:
        The D detections, best score of their boxes first: "boxes" (D, 4) xyxy in the frame of the model's transform,
        "labels" (D,) int64, "scores" (D,), "masks" (D, 1, S, S) probabilities in the frame of the boxes; masks and
        scores are decided by `decide_masks`. And "frame" (2,) int64, width and height of the transform's frame.
    """
    heads = copy.copy(model.roi_heads)  # shares the weights; the model's own thresholds stay as they are
    if nms_thresh is not None:
        heads.nms_thresh = nms_thresh
    if detections_per_img is not None:
        heads.detections_per_img = detections_per_img
    frame = copy.copy(model.transform)
    frame.normalize = partial(normalize, frame)
    if image_size is not None:
        frame.min_size, frame.max_size = (image_size,), image_size
    resized, _ = frame([photo])
    features = model.backbone(resized.tensors)
    if isinstance(features, Tensor):
        features = {"0": features}
    with torch.autocast(photo.device.type, enabled=False):
        dtype = next(heads.parameters()).dtype
        features = OrderedDict((level, values.to(dtype)) for level, values in features.items())
        proposals, _ = model.rpn(resized, features)
        (detections,), _ = heads(features, proposals, resized.image_sizes)
        height, width = resized.image_sizes[0]
        for _ in range(num_growths):
            decided = decide_masks(detections)
            is_good = decided["scores"] >= heads.score_thresh
            detections = {key: values[is_good] for key, values in detections.items()}
            boxes = grow_boxes(detections["boxes"], decided["masks"][is_good], (width, height))
            is_new = (boxes != detections["boxes"]).any(1)
            pooled = heads.mask_roi_pool(features, [boxes[is_new]], resized.image_sizes)
            (masks,) = maskrcnn_inference(heads.mask_predictor(heads.mask_head(pooled)), [detections["labels"][is_new]])
            every = detections["masks"].masked_scatter(is_new[:, None, None, None], masks)
            detections = detections | {"boxes": boxes, "masks": every}
            stays = batched_nms(boxes, detections["scores"], detections["labels"], heads.nms_thresh)
            detections = {key: values[stays] for key, values in detections.items()}
    floats = {key: detections[key].float() for key in ("boxes", "scores", "masks")}
    return decide_masks(detections | floats) | {"frame": torch.tensor([width, height])}


def grow_boxes(boxes: Tensor, masks: Tensor, size: tuple[int, int]) -> Tensor:
    """(D, 4) boxes whose sides move out where masks touch them. A mask ends at its box; one that is cut off there shows
    the rest in a larger one.

    Args:
        boxes: (D, 4) float xyxy, pixels of the frame.
        masks: (D, 1, S, S) probabilities in the frame of the boxes, to be cut at 0.5.
        size: width and height of the frame, which no box leaves.
    """
    inside = (masks[:, 0] > CUT).float()
    sides = torch.stack([inside[:, :, 0], inside[:, 0], inside[:, :, -1], inside[:, -1]], 1).mean(2)
    spans = boxes[:, 2:] - boxes[:, :2]
    grown = boxes + GROWTH * torch.cat((-spans, spans), 1) * (sides > GROWTH)
    return clip_boxes_to_image(grown, size[::-1])


def normalize(transform: GeneralizedRCNNTransform, photo: Tensor) -> Tensor:
    """torchvision's own, with one copy of the photo (3, H, W) instead of two: 290 MB less at 24 megapixels."""
    numbers = transform.image_mean, transform.image_std
    mean, sd = (torch.as_tensor(each, dtype=photo.dtype, device=photo.device) for each in numbers)
    return (photo - mean[:, None, None]).div_(sd[:, None, None])


def detect(model: GeneralizedRCNN, photo: Tensor) -> tuple[dict[str, Tensor], Iterator[Tensor]]:
    """Run `model([photo])[0]` with decided masks, of which one at a time is in memory; arguments as in `run_heads`.
    Returns "boxes" (D, 4) xyxy in the frame of the photo, "labels" (D,), "scores" (D,); and D masks (H, W) float32, 0
    to 1, to be cut at 0.5."""
    detections = run_heads(model, photo)
    size, frame = (photo.shape[1], photo.shape[2]), detections["frame"].tolist()[::-1]
    boxes, masks = resize_boxes(detections["boxes"], frame, size), detections["masks"]
    pasted = (paste_masks_in_image(masks[i : i + 1], boxes[i : i + 1], size)[0, 0] for i in range(len(boxes)))
    return {"boxes": boxes, "labels": detections["labels"], "scores": detections["scores"]}, pasted


def leave_autocast(head: nn.Module, inputs: Any, outputs: tuple[list[Tensor], ...]) -> tuple[list[Tensor], ...]:
    """Forward hook of an RPN's head, for training under autocast: float32 from here on. torchvision would decode
    proposals, and round true boxes, in bfloat16, whose numbers above 256 are even: boxes one pixel wide collapse, and
    their regression loss is not a number."""
    return tuple([level.float() for level in levels] for levels in outputs)
