"""Instances in the photos of a scene: once, again at half the size where leaves may be too large for the detector, and
again, larger, where the plant fills a small part."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from mvseg._version import code_hash
from mvseg.detection.cached_detections import CachedDetections, delete_cached, read_detections, write_detections
from mvseg.detection.config import LEAST_SCORE, MIN_IMAGE_SIZE, DetectConfig
from mvseg.detection.crops import boxes_for_second_pass
from mvseg.detection.find_leaves import Look
from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
from mvseg.detectors.folded_norms import fold_norms
from mvseg.detectors.zoo import load_detector, weights_path
from mvseg.formats.photos import Photos
from mvseg.masks import VERY_SURE, Masks
from mvseg.matching.config import MatchConfig
from mvseg.system.file_hash import hash_files
from mvseg.system.running import progress_bar, timed

UNSURE = 0.5  # leaves may be too large for the detector if less than this fraction of the masks is surely matched
# Root of the area of masks, in pixels as the detector sees them, from which both sizes are better than either: nine in
# ten leaves that detectors train on are smaller (`python benchmarks/training_leaves.py`). The medians of plants that
# fill the photo are about 40, of close-ups 83 to 100 (docs/notes/detector.md).
LARGE = 72.0


def detect_scene(
    photos: Photos,
    config: DetectConfig = DetectConfig(),
    *,
    match: MatchConfig = MatchConfig(),
    cache: Path | None = None,
) -> list[Look]:
    """Look for instances in every photo, and again, larger, where the plant fills a small part of the photos.

    Where less than half of them are surely matched, leaves may be too large: the detector looks once more, at half the
    size, unless the size is given. Where masks are large, both looks count; elsewhere the one stays whose surely
    matched masks cover more.

    Runs on the first GPU, if there is one. One photo at a time is in memory, and those that `Photos` keeps.

    Args:
        photos: of the scene, with its cameras.
        config: which detector, and what it finds.
        match: how detections are matched.
        cache: folder for the detections, see `cached_detections`; those of other photos or options are deleted there.

    Returns:
        The looks that count, one or two, matched with the cameras of the photos.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    cameras = photos.scene.cameras
    seen = _see(photos, config, match=match, cache=cache)
    names, beside = seen.names, None
    if config.image_size is None and share_of_sure(seen.look.sure.masks) < UNSURE:
        longest = min(seen.look.model.transform.max_size, int(cameras.sizes.max()))
        half = replace(config, image_size=max(MIN_IMAGE_SIZE, longest // 2))
        smaller = _see(photos, half, match=match, cache=cache)
        names = names | smaller.names
        if config.verify and median_side(seen.look.sure.masks) * longest >= LARGE * int(cameras.sizes.max()):
            beside = smaller
        else:
            seen = max(seen, smaller, key=lambda each: area_of_sure(each.look.sure.masks))
    if config.crop == "auto" and beside is None:
        boxes = boxes_for_second_pass(seen.look.sure.masks, cameras, longest=seen.look.model.transform.max_size)
        if boxes is not None:
            seen = _detect(seen.look.model, photos, boxes, cached=seen.cached, min_score=config.min_score)
            names = names | seen.names
    if cache is not None:
        delete_cached(cache, but=names)
    return [each.look for each in (seen, beside) if each is not None]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A look, and the files that cache it."""

    look: Look
    cached: CachedDetections | None
    names: set[str]


def _see(photos: Photos, config: DetectConfig, *, match: MatchConfig, cache: Path | None) -> _Seen:
    """Look at whole photos."""
    least = min(LEAST_SCORE, config.min_score) if config.verify else config.min_score
    detector = load_detector(config.weights, image_size=config.image_size, min_score=least)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(fold_norms(detector), num_iterations=config.num_iterations, match=match).to(device)
    cached = None if cache is None else CachedDetections(cache, describe_detector(config, model, device))
    return _detect(model, photos, None, cached=cached, min_score=config.min_score)


def share_of_sure(masks: Masks) -> float:
    """The share of the masks that are surely matched; 0 without masks."""
    return float(_is_sure(masks).float().mean()) if len(masks) else 0.0


def median_side(masks: Masks) -> float:
    """Pixels: the median root of the masks' areas; 0 without masks."""
    return float(masks.regions.areas.double().sqrt().median()) if len(masks) else 0.0


def area_of_sure(masks: Masks) -> float:
    """How many pixels the surely matched masks cover, in all photos."""
    regions = masks.regions
    sure = _is_sure(masks).nonzero()[:, 0].tolist()
    sides = regions.boxes[:, 2:] - regions.boxes[:, :2]
    return sum(float(sides[region].prod() * regions.crop(region).float().mean()) for region in sure)


def _is_sure(masks: Masks) -> Tensor:
    return (masks.instance_ids > 0) & (masks.match_scores >= VERY_SURE)


def _detect(
    model: MultiViewMaskRCNN,
    photos: Photos,
    boxes: Tensor | None,
    *,
    cached: CachedDetections | None,
    min_score: float,
) -> _Seen:
    """What the detector finds in every photo, or in its box (V, 4) xyxy, matched from `min_score` on."""
    found, names, scene = [], set(), photos.scene
    device = next(model.parameters()).device
    with timed("detect"):
        for view in progress_bar(range(len(scene.views)), name="detection", unit="view"):
            box = None if boxes is None else boxes[view].tolist()
            path = cached.path(photos, view, box) if cached is not None and photos.exist else None
            detections = None if path is None else read_detections(path)
            if detections is None:
                x1, y1, x2, y2 = box or (0, 0, *scene.cameras.sizes[view].tolist())
                photo = torch.from_numpy(photos(view)[y1:y2, x1:x2].copy()).to(device).permute(2, 0, 1)
                detections = model.detect(photo.float().div_(255))
                if path is not None:
                    write_detections(path, detections)
            if path is not None:
                names.add(path.name)
            found.append(detections)
    return _Seen(Look.of(model, found, scene.cameras, boxes=boxes, min_score=min_score), cached, names)


def describe_detector(config: DetectConfig, model: MultiViewMaskRCNN, device: str) -> str:
    """Everything but the photo that detections depend on. (What the views say of them does not change them.)"""
    options = asdict(config) | {"weights": hash_files(weights_path(config.weights))}
    options |= {"num_iterations": None, "verify": None, "crop": None, "min_views": None, "min_probability": None}
    options |= {"min_score": min(LEAST_SCORE, config.min_score) if config.verify else config.min_score}
    options |= {"proposals": [model.proposal_iou, model.proposals_per_view], "code": code_hash()}
    return json.dumps(options | {"torch": torch.__version__, "device": device})
