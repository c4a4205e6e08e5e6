"""The proposals of all views as regions, each in the frame of its image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torchvision.models.detection.roi_heads import expand_boxes, expand_masks, paste_mask_in_image
from torchvision.models.detection.transform import resize_boxes

from mvseg.detectors.mask_cut import CUT
from mvseg.masks import Masks, Origin
from mvseg.regions import stack_regions


def gather_proposals(detections: Sequence[dict[str, Tensor]], sizes: list[list[int]]) -> tuple[Masks, Tensor]:
    """Proposals of all views, moved to the frame of the images; masks become box crops, never full frames.

    Args:
        detections: per view `boxes` (R_v, 4), `scores`, `labels`, `masks` (R_v, 1, S, S) probabilities, and `frame`,
            the width and height that the boxes refer to.
        sizes: per view the width and height of the image.

    Returns:
        The R proposals, view after view, matched to nothing; `labels` count them. Crops are what torchvision pastes,
        exactly, where it exceeds 0.5. And (R, 4) float32 xyxy, the detector's boxes in the frames of the images.
    """
    boxes, view_index, windows, crops = [], [], [], []
    for view, (detected, (width, height)) in enumerate(zip(detections, sizes, strict=True)):
        frame_width, frame_height = detected["frame"].tolist()
        scaled = resize_boxes(detected["boxes"], [frame_height, frame_width], [height, width])
        masks, scale = expand_masks(detected["masks"], padding=1)
        for mask, pasted in zip(masks[:, 0], expand_boxes(scaled, scale).to(torch.int64), strict=True):
            x1, y1 = pasted[:2].clamp(min=0).tolist()
            x2, y2 = min(int(pasted[2]) + 1, width), min(int(pasted[3]) + 1, height)
            local = pasted - torch.tensor([x1, y1, x1, y1], device=pasted.device)
            crops.append((paste_mask_in_image(mask, local, y2 - y1, x2 - x1) > CUT).flatten())
            windows.append((x1, y1, x2, y2))
        boxes.append(scaled)
        view_index += [view] * len(scaled)
    device = boxes[0].device
    parts = [crop.cpu() for crop in crops]
    regions = stack_regions(view_index, windows, parts, labels=range(len(crops)), num_views=len(sizes)).to(device)
    scores, classes = (torch.cat([detected[key] for detected in detections]) for key in ("scores", "labels"))
    return Masks.of(regions, detection_scores=scores, classes=classes, origin=Origin.DETECTED), torch.cat(boxes)
