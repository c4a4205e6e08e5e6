"""A Mask R-CNN that proposes masks, one photo at a time, and matches those of all photos (Sec. 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN
from torchvision.models.detection.roi_heads import expand_boxes, expand_masks, paste_mask_in_image
from torchvision.models.detection.transform import resize_boxes

from mvseg.crop import Crop
from mvseg.detection.loop import match_proposals
from mvseg.detection.numbers import DETECTION
from mvseg.detectors.mask_cut import CUT
from mvseg.detectors.run import run_heads
from mvseg.errors import InputError
from mvseg.masks import Masks, Origin
from mvseg.matching.config import MatchConfig
from mvseg.matching.result import Matching
from mvseg.regions import stack_regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Proposer:
    """Steps 1 to 4 of `MultiViewMaskRCNN`, whose options these are."""

    detector: GeneralizedRCNN
    num_iterations: int = 1
    proposal_iou: float = 0.7
    cluster_iou: float = 0.3
    proposals_per_view: int = DETECTION.most_proposals
    match: MatchConfig = MatchConfig()

    @torch.no_grad()
    def propose(self, image: Tensor, *, image_size: int | None = None) -> dict[str, Tensor]:
        """One view's excessive set, as from `run_heads`, without masks that score too low once they are cut.

        Args:
            image: (3, H, W) in [0, 1], on the detector's device.
            image_size: longer side, pixels, that it is scaled to; None: as the detector does.

        Raises:
            InputError: an image of integers.
        """
        check_image(image, "the image")
        detections = run_heads(
            self.detector,
            image,
            nms_thresh=self.proposal_iou,
            detections_per_img=self.proposals_per_view,
            num_growths=DETECTION.num_growths,
            image_size=image_size,
        )
        frame, is_good = detections.pop("frame"), detections["scores"] >= self.detector.roi_heads.score_thresh
        return {key: value[is_good] for key, value in detections.items()} | {"frame": frame}

    @torch.no_grad()
    def match_detections(
        self,
        detections: Sequence[dict[str, Tensor]],
        cameras: Cameras,
        *,
        min_score: float = 0.0,
        residual_px: int | None = None,
    ) -> Matching:
        """Match the output of `propose` for V images, of proposals that score `min_score` or more; by view. `labels` of
        its regions are rows of the excessive set. `residual_px`: see `match_proposals`."""
        cameras = cameras.to(detections[0]["boxes"].device)
        with torch.autocast(cameras.K.device.type, enabled=False):  # pixel counts need single precision
            proposals, boxes = gather_proposals(detections, cameras.sizes.tolist())
            is_asked = (proposals.regions.areas > 0) & (proposals.detection_scores >= min_score)
            matching = match_proposals(
                proposals.select(is_asked),
                cameras,
                boxes=boxes[is_asked],
                num_iterations=self.num_iterations,
                cluster_iou=self.cluster_iou,
                detections_per_view=self.detector.roi_heads.detections_per_img,
                match=self.match,
                residual_px=residual_px,
            )
        return matching.with_masks(matching.masks.select(matching.masks.view_index.argsort(stable=True)))


def check_image(image: Tensor, name: str) -> None:
    """Raises InputError: it is not (3, H, W) of floats in [0, 1]."""
    if not isinstance(image, Tensor):
        raise InputError(f"{name} is a {type(image).__name__}, expected a Tensor: torch.from_numpy(image)")
    if image.ndim != 3 or len(image) != 3:
        raise InputError(f"{name} has shape {tuple(image.shape)}, expected (3, height, width), of red, green and blue")
    if not image.is_floating_point():
        kind = str(image.dtype).removeprefix("torch.")
        raise InputError(f"{name} is {kind}, expected floats in [0, 1]: image.float() / 255")
    if float(image.max()) > DETECTION.brightest:
        raise InputError(f"{name} has values up to {float(image.max()):g}, expected floats in [0, 1]: image / 255")


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
    boxes, rows = [], list[tuple[int, Crop, int]]()
    for view, (detected, (width, height)) in enumerate(zip(detections, sizes, strict=True)):
        frame_width, frame_height = detected["frame"].tolist()
        scaled = resize_boxes(detected["boxes"], [frame_height, frame_width], [height, width])
        masks, scale = expand_masks(detected["masks"], padding=1)
        for mask, pasted in zip(masks[:, 0], expand_boxes(scaled, scale).to(torch.int64), strict=True):
            x1, y1 = pasted[:2].clamp(min=0).tolist()
            x2, y2 = min(int(pasted[2]) + 1, width), min(int(pasted[3]) + 1, height)
            local = pasted - torch.tensor([x1, y1, x1, y1], device=pasted.device)
            pixels = paste_mask_in_image(mask, local, y2 - y1, x2 - x1) > CUT
            rows.append((view, Crop((x1, y1, x2, y2), pixels.cpu()), len(rows)))
        boxes.append(scaled)
    regions = stack_regions(rows, len(sizes)).to(boxes[0].device)
    scores, classes = (torch.cat([detected[key] for detected in detections]) for key in ("scores", "labels"))
    return Masks.of(regions, detection_scores=scores, classes=classes, origin=Origin.DETECTED), torch.cat(boxes)
