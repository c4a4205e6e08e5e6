"""From what a detector proposes in the photos to leaves: match what it is sure of, and more; the views choose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import crop_cameras, place_crops
from mvseg.detection.numbers import DETECTION
from mvseg.detection.proposals import gather_proposals
from mvseg.errors import collect_warnings
from mvseg.findings.finding import Finding
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.matching.result import Matching
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.scene import Cameras
from mvseg.system.running import timed
from mvseg.verification.choose import Judges, Leaves, choose_leaves
from mvseg.verification.leaf_scores import Rating, rate_pass


@dataclass(frozen=True, eq=False)
class Pass:
    """Proposals of a detector in V photos, or in parts of them, seen at one size.

    Attributes:
        match_detections: see `MultiViewMaskRCNN.match_detections`.
        detections: of each photo, as `MultiViewMaskRCNN.detect` gives them.
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


@dataclass(frozen=True, eq=False)
class PassResult:
    """Leaves, and what they were chosen from.

    Attributes:
        leaves: that the views choose; without `DetectConfig.verify`, what was matched.
        proposals: R masks, the excessive set.
        matched: tables of matched masks, the sure ones first; their `labels` are rows of `proposals`.
        pixel: width of a pixel of the detector, in pixels of the photos.
        findings: to warn of, if the result stays.
        colored: (D,) share of each mask of the leaves that has leaf colour; None: it was not looked at.
    """

    detected: Pass
    leaves: Leaves
    proposals: Masks
    matched: tuple[Masks, ...]
    pixel: float
    findings: tuple[Finding, ...] = ()
    colored: Tensor | None = None

    @cached_property
    def rating(self) -> Rating:
        """See `rate_pass`."""
        return rate_pass(self.leaves.masks, self.leaves.probabilities, pixel=self.pixel, colored=self.colored)


def find_leaves(
    detected: Pass,
    cameras: Cameras,
    *,
    config: DetectConfig = DetectConfig(),
    photos: ReadPhoto | None = None,
    cache: SurfaceCache | None = None,
) -> PassResult:
    """The views choose leaves and masks from everything that a pass proposes, see `choose_leaves`. `config`: its
    `verify`, `min_score` and `min_probability` count."""
    matched, proposals = [detected.sure.masks.to("cpu")], detected.proposals()
    if config.verify:
        with collect_warnings():  # said of the sure ones already
            matched.append(detected.match(min(DETECTION.more_score, config.min_score)).masks)
    sides = cameras.sizes if detected.boxes is None else detected.boxes[:, 2:] - detected.boxes[:, :2]
    pixel = int(sides.max()) / detected.longest
    leaves = Leaves.of(matched[0])
    if config.verify:
        judges = Judges(cameras.to("cpu"), photos=photos, min_probability=config.min_probability, cache=cache)
        with timed("choose"):
            leaves = choose_leaves(proposals, matched, judges)
    return PassResult(detected, leaves, proposals, tuple(matched), pixel)
