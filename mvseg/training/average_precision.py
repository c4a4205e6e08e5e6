"""Average precision of a detector's masks and boxes, with pycocotools.

Measured in float32 and in the frame of the original photo, as COCO does. Ignored pixels are a crowd: detections that
lie mostly there count neither for nor against.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torch import Tensor
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.roi_heads import paste_masks_in_image
from torchvision.models.detection.transform import resize_boxes

from mvseg.detectors.mask_cut import CUT, decide_masks
from mvseg.formats.coco import encode_mask
from mvseg.training.data import LabelledPhoto, SampleList, read_sample

MAX_DETECTIONS = 100  # per photo, the best by score; COCO's, and what torchvision's detectors return at most

Annotations = list[dict[str, Any]]


@torch.no_grad()
def detect_and_label(
    model: MaskRCNN, samples: SampleList, indices: Sequence[int], device: torch.device
) -> tuple[Annotations, Annotations]:
    """Run a detector on samples and write down truth and detections as COCO annotations.

    Args:
        model: in eval mode, on `device`.
        samples: all samples.
        indices: which of them to run; the index becomes the annotations' `image_id`.
        device: where the model is.

    Returns:
        Annotations of the truth, annotations of the detections (with "score"); without ids.

    Raises:
        InputError: a sample cannot be read.
    """
    truth: Annotations = []
    detections: Annotations = []
    for index in indices:
        labelled = read_sample(samples.samples[index])
        truth += annotate_truth(labelled, index, len(samples.categories))
        photo = (labelled.photo.float() / 255).to(device)
        detections += annotate_detections(*detect(model, photo), index)
    return truth, detections


def detect(model: MaskRCNN, photo: Tensor) -> tuple[dict[str, Tensor], Iterator[Tensor]]:
    """What `model([photo])[0]` finds, decided by `decide_masks`, with one full-sized mask in memory at a time.

    (torchvision would make all masks at once: 100 detections in a photo of 24 megapixels take some 30 GB.)

    Args:
        model: in eval mode.
        photo: (3, H, W) float32 in [0, 1].

    Returns:
        "boxes" (D, 4) xyxy in the frame of the photo, "labels" (D,), "scores" (D,); and D masks (H, W) float32, 0 to 1,
        to be cut at 0.5.
    """
    images, _ = model.transform([photo])
    features = model.backbone(images.tensors)
    if isinstance(features, Tensor):
        features = {"0": features}
    proposals, _ = model.rpn(images, features)
    found = decide_masks(model.roi_heads(features, proposals, images.image_sizes)[0][0])
    size = (photo.shape[1], photo.shape[2])
    found["boxes"] = resize_boxes(found["boxes"], images.image_sizes[0], size)
    crops, boxes = found.pop("masks"), found["boxes"]
    ones = (slice(index, index + 1) for index in range(len(boxes)))
    return found, (paste_masks_in_image(crops[one], boxes[one], size)[0, 0] for one in ones)


def annotate_truth(labelled: LabelledPhoto, image_id: int, num_categories: int) -> Annotations:
    """COCO annotations of a sample's instances, and one crowd per class that covers its ignored pixels."""
    annotations = []
    for number, category in enumerate(labelled.classes.tolist(), start=1):
        mask = (labelled.layers == number).any(0)
        annotations.append(describe_mask(mask, image_id) | {"category_id": category, "iscrowd": 0})
    if bool(labelled.ignore.any()):
        crowd = describe_mask(labelled.ignore, image_id) | {"iscrowd": 1}
        annotations += [{**crowd, "category_id": category} for category in range(1, num_categories + 1)]
    return annotations


def annotate_detections(found: dict[str, Tensor], masks: Iterable[Tensor], image_id: int) -> Annotations:
    """COCO annotations of what `detect` returned for one photo; masks are cut at 0.5."""
    annotations = []
    for box, category, score, mask in zip(
        found["boxes"].tolist(), found["labels"].tolist(), found["scores"].tolist(), masks, strict=True
    ):
        x1, y1, x2, y2 = box
        described = describe_mask(mask > CUT, image_id)
        annotations.append(
            {**described, "category_id": category, "iscrowd": 0, "score": score, "bbox": [x1, y1, x2 - x1, y2 - y1]}
        )
    return annotations


def describe_mask(mask: Tensor, image_id: int) -> dict[str, Any]:
    """COCO fields of a (H, W) bool mask: run lengths, area in pixels, box xywh."""
    encoded = encode_mask(mask.cpu().numpy())
    return {
        "image_id": image_id,
        "segmentation": encoded,
        "area": float(coco_mask.area(encoded)),
        "bbox": coco_mask.toBbox(encoded).tolist(),
    }


def average_precision(truth: Annotations, detections: Annotations, num_images: int) -> dict[str, float | None]:
    """COCO's average precision of masks and of boxes.

    Args:
        truth: annotations as `detect_and_label` returns them.
        detections: the same, with "score".
        num_images: image ids are 0..num_images - 1; images without any annotation count.

    Returns:
        "mask_AP", "mask_AP50", "mask_AP75", "mask_AR" and the same for "box": in [0, 1], the mean over classes (AP, AR:
        and over IoU 0.50:0.05:0.95), with at most 100 detections per photo. None where the truth has no instance.
    """
    kinds = (("mask", "segm"), ("box", "bbox"))
    return {name: value for kind in kinds for name, value in _evaluate(truth, detections, num_images, *kind).items()}


def _evaluate(
    truth: Annotations, detections: Annotations, num_images: int, name: str, kind: str
) -> dict[str, float | None]:
    categories = sorted({annotation["category_id"] for annotation in truth + detections})
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        evaluation = COCOeval(
            _index(truth, categories, num_images), _index(detections, categories, num_images), kind
        )
        evaluation.params.maxDets = [MAX_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][..., 0, -1]  # IoU thresholds x recalls x classes, any size
    recall = evaluation.eval["recall"][..., 0, -1]
    return {
        f"{name}_AP": _mean(precision),
        f"{name}_AP50": _mean(precision[0]),
        f"{name}_AP75": _mean(precision[5]),
        f"{name}_AR": _mean(recall),
    }


def _index(annotations: Annotations, categories: Sequence[int], num_images: int) -> COCO:
    coco = COCO()
    coco.dataset = {
        # pycocotools wants a size, and reads it for polygons only
        "images": [{"id": index, "height": 1, "width": 1} for index in range(num_images)],
        "categories": [{"id": category} for category in categories],
        "annotations": [{**annotation, "id": number} for number, annotation in enumerate(annotations, start=1)],
    }
    coco.createIndex()
    return coco


def _mean(values: np.ndarray) -> float | None:
    known = values[values > -1]  # -1: a class without truth
    return float(known.mean()) if known.size else None
