"""From what a detector proposes in the photos to leaves: match what it is sure of, and more; the views choose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

from torch import Tensor

from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import crop_cameras, place_crops
from mvseg.detection.numbers import DETECTION
from mvseg.detection.proposals import gather_proposals
from mvseg.errors import collect_warnings
from mvseg.findings.finding import Finding
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.regions import stack_regions
from mvseg.scene import Cameras
from mvseg.system.running import timed
from mvseg.verification.choose import Judges, Leaves, choose_leaves
from mvseg.verification.leaf_scores import Rating, rate_pass


class Detector(Protocol):
    """The parts of a `MultiViewMaskRCNN` that a pass needs."""

    transform: Any  # torchvision's

    def parameters(self) -> Iterator[Tensor]: ...

    def match_detections(
        self,
        detections: Sequence[dict[str, Tensor]],
        cameras: Cameras,
        *,
        min_score: float,
        residual_px: int | None = None,
    ) -> Matching: ...


@dataclass(frozen=True, eq=False)
class Pass:
    """Proposals of a detector in V photos, or in parts of them, seen at one size.

    Attributes:
        model: that proposed it, and matches it.
        detections: of each photo, as `MultiViewMaskRCNN.detect` gives them.
        boxes: (V, 4) int64 xyxy, the parts of the photos that were looked at; None: all of them.
        sure: the proposals that score enough to be matched at first, matched, see `match`.
    """

    model: Detector
    detections: Sequence[dict[str, Tensor]]
    boxes: Tensor | None
    sure: Matching

    @staticmethod
    def of(
        model: Detector,
        detections: Sequence[dict[str, Tensor]],
        cameras: Cameras,
        *,
        boxes: Tensor | None = None,
        min_score: float,
    ) -> Pass:
        """A pass, matched from `min_score` on with the V cameras of the photos."""
        nothing = Matching(Masks.of(stack_regions([], [], [], labels=[], num_views=len(cameras))), MatchReport("none"))
        unmatched = Pass(model, detections, boxes, nothing)
        return replace(unmatched, sure=unmatched.match(cameras, min_score))

    @property
    def longest(self) -> int:
        """Pixels: the longer side of the largest photo, or part, as the detector sees it."""
        return max(int(each["frame"].max()) for each in self.detections)

    def proposals(self, cameras: Cameras) -> Masks:
        """The excessive set: R masks on the CPU, in the frames of the photos, matched to nothing."""
        masks, _ = gather_proposals(self.detections, self._posed(cameras).sizes.tolist())
        return masks if self.boxes is None else place_crops(masks, self.boxes)

    def match(self, cameras: Cameras, min_score: float) -> Matching:
        """Match proposals that score `min_score` or more with the V cameras of the photos, in their frames; `labels`
        are rows of `proposals`. The reprojection error is that of `sure`: the poses are the same."""
        with timed("match"):
            matching = self.model.match_detections(
                self.detections,
                self._posed(cameras),
                min_score=min_score,
                residual_px=self.sure.report.residual_px,
            )
        return matching if self.boxes is None else matching.with_masks(place_crops(matching.masks, self.boxes))

    def _posed(self, cameras: Cameras) -> Cameras:
        return cameras if self.boxes is None else crop_cameras(cameras, self.boxes)


@dataclass(frozen=True, eq=False)
class PassResult:
    """The leaves that were found, and what they were chosen from.

    Attributes:
        passes: at the photos, that the proposals come from.
        leaves: that the views choose; without `DetectConfig.verify`, what was matched.
        proposals: R masks, the excessive set.
        matched: tables of masks that are matched, the sure ones first; their `labels` are rows of `proposals`.
        report: of the sure ones.
        pixel: width of a pixel of the detector in the first pass, in pixels of the photos.
        findings: to warn of, if the result stays.
        colored: (D,) share of each mask of the leaves that has leaf colour; None: it was not looked at.
    """

    passes: tuple[Pass, ...]
    leaves: Leaves
    proposals: Masks
    matched: tuple[Masks, ...]
    report: MatchReport
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
    """The views choose leaves and masks from everything that a pass proposes, see `choose_leaves`.

    Args:
        detected: matched with the same cameras.
        config: `verify`, `min_score` and `min_probability`.
        photos: of the views, for the colours of leaves.
    """
    proposals, first = detected.proposals(cameras), detected.sure.masks.to("cpu")
    matched = [first]
    if config.verify:
        with collect_warnings():  # said of the sure ones already
            matched.append(detected.match(cameras, min(DETECTION.more_score, config.min_score)).masks)
    sides = cameras.sizes if detected.boxes is None else detected.boxes[:, 2:] - detected.boxes[:, :2]
    pixel = int(sides.max()) / detected.longest
    leaves = Leaves.of(matched[0])
    if config.verify:
        judges = Judges(cameras.to("cpu"), photos=photos, min_probability=config.min_probability, cache=cache)
        with timed("choose"):
            leaves = choose_leaves(proposals, matched, judges)
    return PassResult((detected,), leaves, proposals, tuple(matched), detected.sure.report, pixel)
