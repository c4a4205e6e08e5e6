"""Symmetric best Dice and the difference in count, as the CVPPP leaf segmentation challenge judges photos.

Scharr et al., "Leaf segmentation in plant phenotyping: a collation study", Machine Vision and Applications 2016.
"""

from __future__ import annotations

import numpy as np
from pycocotools import mask as coco_mask

from mvseg.evaluation.average_precision import Annotations


def count_and_dice(
    truth: Annotations, detections: Annotations, num_images: int, *, min_score: float
) -> dict[str, float]:
    """Means over the photos. Categories are not told apart, and ignored areas (crowds) are left out of the truth.

    Args:
        truth: annotations of the true instances, see `annotate_truth`.
        detections: annotations with "score", see `annotate_detections`; their masks may overlap.
        num_images: image ids are 0..num_images - 1.
        min_score: detections that score less do not count.

    Returns:
        "sbd": the smaller of the mean best Dice of the true masks among the detections and the reverse, in [0, 1]; 1
        for a photo without leaves and detections, 0 for one with only either. "count_difference": detections minus
        leaves. "absolute_count_difference": its absolute value, photo by photo.

    Raises:
        ValueError: no images.
    """
    if num_images < 1:
        raise ValueError("no images, expected at least one")
    dice, difference = np.zeros(num_images), np.zeros(num_images)
    for image in range(num_images):
        true = [each["segmentation"] for each in truth if each["image_id"] == image and not each["iscrowd"]]
        found = [
            each["segmentation"] for each in detections if each["image_id"] == image and each["score"] >= min_score
        ]
        difference[image] = len(found) - len(true)
        if not true or not found:
            dice[image] = float(not true and not found)
            continue
        iou = coco_mask.iou(found, true, [0] * len(true))
        dices = 2 * iou / (1 + iou)
        dice[image] = min(dices.max(0).mean(), dices.max(1).mean())
    return {
        "sbd": float(dice.mean()),
        "count_difference": float(difference.mean()),
        "absolute_count_difference": float(np.abs(difference).mean()),
    }
