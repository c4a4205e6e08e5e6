"""Instances in the photos of a scene: once, again at half the size where leaves may be too large for the detector, and
again, larger, where the plant fills a small part."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import torch
from torch import Tensor

from mvseg._version import code_hash
from mvseg.detection.cached_detections import CachedDetections, delete_cached, read_detections, write_detections
from mvseg.detection.config import LEAST_SCORE, MIN_IMAGE_SIZE, MORE_SCORE, DetectConfig
from mvseg.detection.crops import boxes_for_second_pass, crop_cameras, place_crops
from mvseg.detection.mask_rcnn import MultiViewMaskRCNN, list_proposals
from mvseg.detectors.folded_norms import fold_norms
from mvseg.detectors.zoo import load_detector, weights_path
from mvseg.formats.photos import Photos
from mvseg.masks import VERY_SURE, Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.result import Matching
from mvseg.scene import Cameras
from mvseg.system.file_hash import hash_files
from mvseg.system.running import progress_bar

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
) -> Found:
    """Find instances in every photo, and again, larger, where the plant fills a small part of the photos.

    Where less than half of them are surely matched, leaves may be too large: the detector looks once more, at half the
    size, unless the size is given. Where masks are large, both looks count; elsewhere the one stays whose surely
    matched masks cover more.

    Runs on the first GPU, if there is one. One photo at a time is in memory, and those that `Photos` keeps.

    Args:
        photos: of the scene, with its cameras.
        config: which detector, and what it finds; `config.verify` is a stage of its own.
        match: how detections are matched.
        cache: folder for the detections, see `cached_detections`; those of other photos or options are deleted there.

    Returns:
        What was found. With the cameras of the photos it is matched already where the plant fills the photos.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    look = partial(_look, photos, match=match, cache=cache)
    seen, cameras = look(config), photos.scene.cameras
    names, beside = seen.names, None
    if config.image_size is None and share_of_sure(seen.match(cameras).masks) < UNSURE:
        longest = min(seen.model.transform.max_size, int(cameras.sizes.max()))
        smaller = look(replace(config, image_size=max(MIN_IMAGE_SIZE, longest // 2)))
        names = names | smaller.names
        if config.verify and median_side(seen.match(cameras).masks) * longest >= LARGE * int(cameras.sizes.max()):
            beside = Found(smaller.model, smaller.detections, None, config.min_score, smaller.match)
        else:
            seen = max(seen, smaller, key=lambda each: area_of_sure(each.match(cameras).masks))
    boxes = None
    if config.crop == "auto" and beside is None:
        boxes = boxes_for_second_pass(seen.match(cameras).masks, cameras, longest=seen.model.transform.max_size)
    if boxes is not None:
        in_crops, more_names = _detect_photos(seen.model, photos, boxes, cached=seen.cached)
        names = names | more_names
    if cache is not None:
        delete_cached(cache, but=names)
    if boxes is None:
        return Found(seen.model, seen.detections, None, config.min_score, seen.match, beside)
    return Found(seen.model, in_crops, boxes, config.min_score)


@dataclass(frozen=True, eq=False)
class Found:
    """What a detector finds in the photos of a scene.

    Attributes:
        model: that matches it.
        detections: of every photo, or of its box, as `MultiViewMaskRCNN.detect` gives them.
        boxes: (V, 4) int64 xyxy, the parts of the photos that were looked at; None: all of them.
        min_score: of what is matched at first.
        match_sure: from cameras to what is matched at first, where somebody has matched it before.
        beside: what it finds at another size, where leaves are large.
    """

    model: MultiViewMaskRCNN
    detections: list[dict[str, Tensor]]
    boxes: Tensor | None
    min_score: float
    match_sure: Callable[[Cameras], Matching] | None = None
    beside: Found | None = None

    def match(self, cameras: Cameras) -> Matching:
        """The sure proposals, matched with V cameras, in the frames of the photos; `labels` are rows of `proposals`."""
        return self.match_from(cameras, self.min_score) if self.match_sure is None else self.match_sure(cameras)

    def match_from(self, cameras: Cameras, min_score: float) -> Matching:
        """The same of the proposals with a score of `min_score` or more."""
        return _match(self, cameras, min_score)

    def match_more(self, cameras: Cameras) -> tuple[Masks, ...]:
        """Other matchings, for more candidates: of weaker proposals, and of those of another size."""
        more = (self.match_from(cameras, min(MORE_SCORE, self.min_score)).masks,)
        if self.beside is None:
            return more
        offset = len(self._own_proposals(cameras))
        others = self.beside.match(cameras).masks, *self.beside.match_more(cameras)
        return *more, *(replace(each, regions=replace(each.regions, labels=each.regions.labels + offset))
                        for each in others)  # fmt: skip

    def proposals(self, cameras: Cameras) -> Masks:
        """The excessive set: all proposals, matched to nothing, in the frames of the photos."""
        own = self._own_proposals(cameras)
        return own if self.beside is None else Masks.concatenate((own, self.beside.proposals(cameras)))

    def _own_proposals(self, cameras: Cameras) -> Masks:
        masks = list_proposals(self.detections, cameras if self.boxes is None else crop_cameras(cameras, self.boxes))
        return masks if self.boxes is None else place_crops(masks, self.boxes)


@lru_cache(maxsize=4)  # each edit of a person asks again
def _match(found: Found, cameras: Cameras, min_score: float) -> Matching:
    posed = cameras if found.boxes is None else crop_cameras(cameras, found.boxes)
    matching = found.model.match_detections(found.detections, posed, min_score=min_score)
    return matching if found.boxes is None else matching.with_masks(place_crops(matching.masks, found.boxes))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a detector finds in whole photos at one size: the files that cache it, and how it is matched."""

    model: MultiViewMaskRCNN
    cached: CachedDetections | None
    names: set[str]
    detections: list[dict[str, Tensor]]
    match: Callable[[Cameras], Matching]


def _look(photos: Photos, config: DetectConfig, *, match: MatchConfig, cache: Path | None) -> _Seen:
    """Find instances in whole photos."""
    least = min(LEAST_SCORE, config.min_score) if config.verify else config.min_score
    detector = load_detector(config.weights, image_size=config.image_size, min_score=least)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(fold_norms(detector), num_iterations=config.num_iterations, match=match).to(device)
    cached = None if cache is None else CachedDetections(cache, describe_detector(config, model, device))
    found, names = _detect_photos(model, photos, cached=cached)
    # whole photos are matched to find the plant, and not again by who asks for that
    match_found = partial(model.match_detections, found, min_score=config.min_score)
    return _Seen(model, cached, names, found, lru_cache(maxsize=1)(match_found))


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


def _detect_photos(
    model: MultiViewMaskRCNN,
    photos: Photos,
    boxes: Tensor | None = None,
    *,
    cached: CachedDetections | None,
) -> tuple[list[dict[str, Tensor]], set[str]]:
    """What the detector finds in every photo, or in its box (V, 4) xyxy, and the names of the files that cache it."""
    found, names, scene = [], set(), photos.scene
    device = next(model.parameters()).device
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
    return found, names


def describe_detector(config: DetectConfig, model: MultiViewMaskRCNN, device: str) -> str:
    """Everything but the photo that detections depend on. (What the views say of them does not change them.)"""
    options = asdict(config) | {"weights": hash_files(weights_path(config.weights))}
    options |= {"num_iterations": None, "verify": None, "crop": None, "min_views": None, "min_probability": None}
    options |= {"min_score": min(LEAST_SCORE, config.min_score) if config.verify else config.min_score}
    options |= {"proposals": [model.proposal_iou, model.proposals_per_view], "code": code_hash()}
    return json.dumps(options | {"torch": torch.__version__, "device": device})
