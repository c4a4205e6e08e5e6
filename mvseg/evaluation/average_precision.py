"""Average precision of masks and boxes (AP), with pycocotools.

Measured in the frame of the original photo, as COCO does. Ignored pixels are a crowd: detections that lie mostly there
count neither for nor against.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torch import Tensor

from mvseg.evaluation.labelled_photo import LabelledPhoto
from mvseg.formats.run_lengths import encode_mask

MAX_DETECTIONS = 100  # definition: per photo, the best by score: COCO's limit, and that of torchvision's detectors

Annotations = list[dict[str, Any]]


def annotate_truth(labelled: LabelledPhoto, image_id: int, num_categories: int) -> Annotations:
    """COCO annotations of the instances of photo 0, 1, ..., and, per category 1..num_categories, one crowd that covers
    its ignored pixels."""
    annotations = []
    for number, category in enumerate(labelled.classes.tolist(), start=1):
        mask = (labelled.layers == number).any(0)
        annotations.append(describe_mask(mask, image_id) | {"category_id": category, "iscrowd": 0})
    if bool(labelled.ignore.any()):
        crowd = describe_mask(labelled.ignore, image_id) | {"iscrowd": 1}
        annotations += [{**crowd, "category_id": category} for category in range(1, num_categories + 1)]
    return annotations


def annotate_detections(detections: dict[str, Tensor], masks: Iterable[Tensor], image_id: int) -> Annotations:
    """COCO annotations of the detections in photo 0, 1, ...: "boxes" (D, 4) xyxy, "labels" (D,), "scores" (D,); and D
    masks (H, W) of probabilities, cut at 0.5 here, as torchvision's are by convention."""
    columns = (detections[key].tolist() for key in ("boxes", "labels", "scores"))
    return [
        describe_mask(mask > 0.5, image_id)
        | {"category_id": category, "iscrowd": 0, "score": score, "bbox": [x1, y1, x2 - x1, y2 - y1]}
        for (x1, y1, x2, y2), category, score, mask in zip(*columns, masks, strict=True)
    ]


def describe_mask(mask: Tensor, image_id: int) -> dict[str, Any]:
    """COCO fields of a (H, W) bool mask: run lengths, area in pixels, box xywh."""
    encoded = encode_mask(mask.cpu().numpy())
    area, box = float(coco_mask.area(encoded)), coco_mask.toBbox(encoded).tolist()
    return {"image_id": image_id, "segmentation": encoded, "area": area, "bbox": box}


def average_precision(truth: Annotations, detections: Annotations, num_images: int) -> dict[str, float | None]:
    """COCO's average precision of masks and of boxes, of annotations by `annotate_truth` and `annotate_detections`;
    image ids are 0..num_images - 1, and images without any annotation count.

    Returns:
        "mask_AP", "mask_AP50", "mask_AP75", "mask_AR" and the same for "box": in [0, 1], the mean over classes (AP, AR:
        and over IoU 0.50:0.05:0.95), with at most 100 detections per photo. None where the truth has no instance.
    """
    categories = sorted({annotation["category_id"] for annotation in truth + detections})
    scores: dict[str, float | None] = {}
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        true, detected = (_index(annotations, categories, num_images) for annotations in (truth, detections))
        for name, kind in (("mask", "segm"), ("box", "bbox")):
            scores |= {f"{name}_{key}": value for key, value in _evaluate(COCOeval(true, detected, kind)).items()}
    return scores


def _evaluate(evaluation: COCOeval) -> dict[str, float | None]:
    evaluation.params.maxDets = [MAX_DETECTIONS]
    evaluation.evaluate()
    evaluation.accumulate()
    precision = evaluation.eval["precision"][..., 0, -1]  # IoU thresholds x recalls x classes, any size
    recall = evaluation.eval["recall"][..., 0, -1]
    return {"AP": _mean(precision), "AP50": _mean(precision[0]), "AP75": _mean(precision[5]), "AR": _mean(recall)}


def _index(annotations: Annotations, categories: Sequence[int], num_images: int) -> COCO:
    coco = COCO()
    coco.dataset = {
        # pycocotools requires a size, but uses it for polygons only
        "images": [{"id": index, "height": 1, "width": 1} for index in range(num_images)],
        "categories": [{"id": category} for category in categories],
        "annotations": [{**annotation, "id": number} for number, annotation in enumerate(annotations, start=1)],
    }
    coco.createIndex()
    return coco


def _mean(values: np.ndarray) -> float | None:
    defined = values[values > -1]  # -1: a class without truth
    return float(defined.mean()) if defined.size else None
