"""Instances in the photos of a scene, seen at one size: once, and again, larger, where the plant fills a small part."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial

import torch
from torch import Tensor

from mvseg._version import code_hash
from mvseg.detection.cached_detections import CachedDetections, read_detections, write_detections
from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import boxes_for_second_pass
from mvseg.detection.find_leaves import Pass
from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
from mvseg.detection.numbers import DETECTION
from mvseg.detectors.folded_norms import fold_norms
from mvseg.detectors.zoo import load_detector, weights_path
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.matching.config import MatchConfig
from mvseg.system.file_hash import hash_files
from mvseg.system.running import progress_bar, timed


def detect_scene(
    photos: Photos,
    config: DetectConfig = DetectConfig(),
    *,
    match: MatchConfig = MatchConfig(),
    cache: CachedDetections | None = None,
    boxes: Tensor | None = None,
) -> Pass:
    """Look for instances in every photo, and again, larger, where the plant fills a small part of the photos.

    Runs on the first GPU, if there is one. One photo at a time is in memory, and those that `Photos` keeps. Warns
    (InputWarning) of more proposals than are taken: a detector that knows nothing proposes masks everywhere.

    Args:
        boxes: (V, 4) int64 xyxy, the parts of the photos that show the plant, from an earlier pass; None: look for it.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    least = min(DETECTION.least_score, config.min_score) if config.verify else config.min_score
    detector = load_detector(config.weights, image_size=config.image_size, min_score=least)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(
        fold_norms(detector),
        num_iterations=config.num_iterations,
        proposals_per_view=DETECTION.most_proposals,
        match=match,
    ).to(device)
    made_by = describe_detector(config, model, device)

    detect = partial(_detect, model, photos, min_score=config.min_score, cache=cache, made_by=made_by)
    detected = detect(boxes)
    if boxes is None and config.crop == "auto":
        boxes = boxes_for_second_pass(detected.sure.masks, detected.cameras, longest=model.transform.max_size)
        detected = detected if boxes is None else detect(boxes)
    if num_full := sum(len(each["scores"]) >= DETECTION.most_proposals for each in detected.detections):
        values = {"count": num_full, "most": DETECTION.most_proposals}
        warn(Finding("very_many_proposals", values=values))
    return detected


def _detect(
    model: MultiViewMaskRCNN,
    photos: Photos,
    boxes: Tensor | None,
    *,
    min_score: float,
    cache: CachedDetections | None,
    made_by: str,
) -> Pass:
    """One pass over every photo, or its box (V, 4) xyxy."""
    every, scene = [], photos.scene
    device = next(model.parameters()).device
    with timed("detect"):
        for view in progress_bar(range(len(scene.views)), name="detection", unit="view"):
            whole = [0, 0, *scene.cameras.sizes[view].tolist()]
            box = None if boxes is None or boxes[view].tolist() == whole else boxes[view].tolist()
            path = None if cache is None or not photos.exist else cache.path(photos, view, box, made_by=made_by)
            detections = None if path is None else read_detections(path)
            if detections is None:
                x1, y1, x2, y2 = box or whole
                photo = torch.from_numpy(photos(view)[y1:y2, x1:x2].copy()).to(device).permute(2, 0, 1)
                detections = model.detect(photo.float().div_(255))
                if path is not None:
                    write_detections(path, detections)
            every.append(detections)
    return Pass(model.match_detections, every, scene.cameras, min_score, boxes)


def describe_detector(config: DetectConfig, model: MultiViewMaskRCNN, device: str) -> str:
    """Everything but the photo that detections depend on. (What the views say of them does not change them.)"""
    options = asdict(config) | {"weights": hash_files(weights_path(config.weights))}
    options |= {"num_iterations": None, "verify": None, "crop": None, "min_probability": None}
    options |= {"min_score": min(DETECTION.least_score, config.min_score) if config.verify else config.min_score}
    options |= {"proposals": [model.proposal_iou, model.proposals_per_view], "code": code_hash()}
    return json.dumps(options | {"torch": torch.__version__, "device": device})
