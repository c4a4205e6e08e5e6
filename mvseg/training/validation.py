"""Detections and truth of samples, as input of average precision."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torchvision.models.detection import MaskRCNN

from mvseg.detectors.run import detect
from mvseg.evaluation.average_precision import Annotations, annotate_detections, annotate_truth
from mvseg.training.data import SampleList, read_sample


@torch.no_grad()
def detect_and_label(model: MaskRCNN, samples: SampleList, indices: Iterable[int]) -> tuple[Annotations, Annotations]:
    """Truth and detections (with "score") of those samples as COCO annotations without ids; the index is `image_id`.
    The model is in eval mode; photos go to the device of its parameters. Raises InputError: a sample cannot be read."""
    device = next(model.parameters()).device
    truth: Annotations = []
    detections: Annotations = []
    for index in indices:
        labelled = read_sample(samples.samples[index])
        truth += annotate_truth(labelled, index, len(samples.categories))
        photo = (labelled.photo.float() / 255).to(device)
        detections += annotate_detections(*detect(model, photo), index)
    return truth, detections
