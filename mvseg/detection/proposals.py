"""The proposals of all views as regions, each in the frame of its image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torchvision.models.detection.roi_heads import expand_boxes, expand_masks, paste_mask_in_image
from torchvision.models.detection.transform import resize_boxes

from mvseg.detectors.mask_cut import CUT
from mvseg.masks import Masks, Origin
from mvseg.regions import Regions, stack_regions


@dataclass(frozen=True, eq=False)
class Proposals:
    """R scored masks of V views before matching, many of them of the same object.

    Attributes:
        regions: the R masks as box crops, in the frame of the images; `labels` counts them.
        boxes: (R, 4) float32 xyxy in the frame of the images; what NMS compares.
        scores: (R,) float32.
        classes: (R,) int64; objects of different classes are never matched.
    """

    regions: Regions
    boxes: Tensor
    scores: Tensor
    classes: Tensor

    def select(self, index: Tensor) -> Proposals:
        """The proposals at an int64 index, in that order."""
        return Proposals(
            regions=self.regions.select(index),
            boxes=self.boxes[index],
            scores=self.scores[index],
            classes=self.classes[index],
        )

    def as_masks(self) -> Masks:
        """The table of these masks, matched to nothing."""
        return Masks.of(
            self.regions, detection_scores=self.scores, classes=self.classes, origin=Origin.DETECTED
        )


def gather_proposals(detections: list[dict[str, Tensor]], sizes: list[list[int]]) -> Proposals:
    """Proposals of all views, moved to the frame of the images; masks become box crops, never full frames.

    Args:
        detections: per view `boxes` (R_v, 4), `scores`, `labels`, `masks` (R_v, 1, S, S) probabilities, and `frame`,
            the width and height that the boxes refer to.
        sizes: per view the width and height of the image.

    Returns:
        The proposals, view after view. The crops are what torchvision pastes, exactly, where it exceeds 0.5.
    """
    boxes, view_index, windows, crops = [], [], [], []
    for view, (shown, (width, height)) in enumerate(zip(detections, sizes, strict=True)):
        frame_width, frame_height = shown["frame"].tolist()
        scaled = resize_boxes(shown["boxes"], [frame_height, frame_width], [height, width])
        masks, scale = expand_masks(shown["masks"], padding=1)
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
    scores, classes = (torch.cat([shown[key] for shown in detections]) for key in ("scores", "labels"))
    return Proposals(regions=regions, boxes=torch.cat(boxes), scores=scores, classes=classes)
