"""Cuts of a mask head's probabilities, and how good the masks then are: by their expected IoU.

Cutting at 0.5 minimises the expected number of wrong pixels, not the IoU that masks are judged by: a thin leaf that the
head is unsure of never reaches 0.5, and its mask comes out empty or in pieces. Of all cuts we take the one with the
largest expected IoU (after Nowozin, "Optimal Decisions from Probabilistic Models: the Intersection-over-Union Case",
CVPR 2014; here the expectation of the intersection over that of the union), and multiply the score of the box by it (as
Huang et al., "Mask Scoring R-CNN", CVPR 2019, do with an IoU that they learn). Nothing is learned, nothing tuned.
"""

from __future__ import annotations

import torch
from torch import Tensor

CUT = 0.5  # definition: where the masks of torchvision's detectors are cut, by convention
EPS = 1e-9  # limit: probabilities are kept this far from 0 and 1, where log odds are infinite


def expect_iou(probabilities: Tensor) -> tuple[Tensor, Tensor]:
    """The cut with the largest expected IoU of each mask, of `probabilities` (D, P) float in [0, 1], P >= 1.

    Returns (D,) float64 cuts: the mask is where the probability is larger. Half-way (in log odds) between the smallest
    probability inside and the largest outside, or 1e-9 when none is outside. And (D,) float64 expected IoU.
    """
    p = probabilities.double().sort(dim=1, descending=True).values
    sums, counts = p.cumsum(1), torch.arange(1, p.shape[1] + 1, device=p.device)
    # the k largest inside: intersection sums[k], union k + what is expected of the others
    expected, last = (sums / (counts + sums[:, -1:] - sums)).max(dim=1)
    log_odds = torch.cat((p, torch.zeros_like(p[:, :1])), 1).logit(eps=EPS)
    cuts = torch.stack([log_odds.gather(1, index[:, None])[:, 0] for index in (last, last + 1)]).mean(0).sigmoid()
    return cuts, expected


def decide_masks(detections: dict[str, Tensor]) -> dict[str, Tensor]:
    """Detections whose masks are best cut at 0.5, and whose scores include the quality of the mask.

    Among the results of torchvision's RoI heads for a photo, "masks" (D, 1, S, S), probabilities in the frame of the
    boxes, get log odds that are shifted so that the best cut of each falls on 0.5, and "scores" (D,) are multiplied by
    the expected IoU. All else, and the order of the detections, stays.
    """
    masks, scores = detections["masks"], detections["scores"]
    cuts, expected = expect_iou(masks.flatten(1))
    log_odds = masks.double().logit(eps=EPS) - cuts.logit(eps=EPS)[:, None, None, None]
    return detections | {"masks": log_odds.sigmoid().to(masks.dtype), "scores": (scores * expected).to(scores.dtype)}
