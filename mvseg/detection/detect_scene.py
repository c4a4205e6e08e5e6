"""Instances in the photos of a scene, seen at one size: once, and again, larger, where the plant fills a small part."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial

import safetensors.torch
import torch
from torch import Tensor

from mvseg._version import code_hash
from mvseg.detection.cached_detections import CachedDetections, describe_photo, encode_detections, read_detections
from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import boxes_for_second_pass, crop_cameras, place_crops
from mvseg.detection.numbers import DETECTION
from mvseg.detection.proposals import Proposer, gather_proposals
from mvseg.detectors.folded_norms import fold_norms
from mvseg.detectors.zoo import load_detector, weights_path
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.result import Matching
from mvseg.scene import Cameras
from mvseg.system.file_hash import hash_files
from mvseg.system.running import progress_bar, timed


@dataclass(frozen=True, eq=False)
class Pass:
    """Proposals of a detector in V photos, or in parts of them, seen at one size.

    Attributes:
        match_detections: see `Proposer.match_detections`.
        detections: of each photo, as `Proposer.propose` gives them.
        cameras: V, of the photos.
        min_score: of the proposals that are matched at first.
        boxes: (V, 4) int64 xyxy, the parts of the photos that were looked at; None: all of them.
    """

    match_detections: Callable[..., Matching]
    detections: Sequence[dict[str, Tensor]]
    cameras: Cameras
    min_score: float
    boxes: Tensor | None = None

    @cached_property
    def sure(self) -> Matching:
        """The proposals that are matched at first, see `match`."""
        return self._match(self.min_score)

    @property
    def longest(self) -> int:
        """Pixels: the longer side of the largest photo, or part, as the detector sees it."""
        return max(int(each["frame"].max()) for each in self.detections)

    @property
    def posed(self) -> Cameras:
        """V cameras of the photos, or of their parts."""
        return self.cameras if self.boxes is None else crop_cameras(self.cameras, self.boxes)

    def proposals(self) -> Masks:
        """The excessive set: R masks on the CPU, in the frames of the photos, matched to nothing."""
        masks, _ = gather_proposals(self.detections, self.posed.sizes.tolist())
        return masks if self.boxes is None else place_crops(masks, self.boxes)

    def match(self, min_score: float) -> Matching:
        """Match proposals that score `min_score` or more, in the frames of the photos; `labels` are rows of
        `proposals`. The reprojection error is that of `sure`: the poses are the same."""
        return self._match(min_score, self.sure.report.residual_px)

    def _match(self, min_score: float, residual_px: int | None = None) -> Matching:
        with timed("match"):
            matching = self.match_detections(self.detections, self.posed, min_score=min_score, residual_px=residual_px)
        return matching if self.boxes is None else matching.with_masks(place_crops(matching.masks, self.boxes))


def detect_scene(
    photos: Photos,
    config: DetectConfig = DetectConfig(),
    *,
    match: MatchConfig = MatchConfig(),
    cache: CachedDetections | None = None,
    boxes: Tensor | None = None,
    proposer: Proposer | None = None,
) -> Pass:
    """Look for instances in every photo, and again, larger, where the plant fills a small part of the photos.

    Runs on the first GPU, if there is one. One photo at a time is in memory, and those that `Photos` keeps. Warns
    (InputWarning) of more proposals than are taken: a detector that knows nothing proposes masks everywhere.

    Args:
        boxes: (V, 4) int64 xyxy, the parts of the photos that show the plant, from an earlier pass; None: look for it.
        proposer: with a detector, in place of one by its weights.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    if proposer is None:
        least = min(DETECTION.least_score, config.min_score) if config.verify else config.min_score
        detector = load_detector(config.weights, image_size=config.image_size, min_score=least)
        detector = fold_norms(detector).to("cuda" if torch.cuda.is_available() else "cpu")
        most = DETECTION.most_proposals
        proposer = Proposer(detector, num_iterations=config.num_iterations, proposals_per_view=most, match=match)
    detect = partial(_detect, proposer, photos, config=config, cache=cache)
    detected = detect(boxes)
    if boxes is None and config.crop == "auto":
        longest = config.image_size or proposer.detector.transform.max_size
        boxes = boxes_for_second_pass(detected.sure.masks, detected.cameras, longest=longest)
        detected = detected if boxes is None else detect(boxes)
    if num_full := sum(len(each["scores"]) >= DETECTION.most_proposals for each in detected.detections):
        values = {"count": num_full, "most": DETECTION.most_proposals}
        warn(Finding("very_many_proposals", values=values))
    return detected


def _detect(
    proposer: Proposer, photos: Photos, boxes: Tensor | None, *, config: DetectConfig, cache: CachedDetections | None
) -> Pass:
    every, scene = [], photos.scene
    device = next(proposer.detector.parameters()).device
    made_by = "" if cache is None else describe_detector(config, proposer, str(device.type))

    def look(view: int, box: Sequence[int]) -> bytes:
        x1, y1, x2, y2 = box
        photo = torch.from_numpy(photos(view)[y1:y2, x1:x2].copy()).to(device).permute(2, 0, 1)
        return encode_detections(proposer.propose(photo.float().div_(255), image_size=config.image_size))

    with timed("detect"):
        for view in progress_bar(range(len(scene.views)), name="detection", unit="view"):
            box = [0, 0, *scene.cameras.sizes[view].tolist()] if boxes is None else boxes[view].tolist()
            if cache is None or not photos.exist:
                every.append(safetensors.torch.load(look(view, box)))
            else:
                made_from = [*describe_photo(photos, view), made_by, box]
                every.append(cache.get(made_from, partial(look, view, box), read_detections))
    return Pass(proposer.match_detections, every, scene.cameras, config.min_score, boxes)


def describe_detector(config: DetectConfig, proposer: Proposer, device: str) -> str:
    """Everything but the photo that detections depend on. (What the views say of them does not change them.)"""
    options = asdict(config) | {"weights": hash_files(weights_path(config.weights))}
    options |= {"num_iterations": None, "verify": None, "crop": None, "min_probability": None}
    options |= {"min_score": min(DETECTION.least_score, config.min_score) if config.verify else config.min_score}
    options |= {"proposals": [proposer.proposal_iou, proposer.proposals_per_view], "code": code_hash()}
    return json.dumps(options | {"torch": torch.__version__, "device": device})
