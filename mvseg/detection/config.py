"""How instances are found in photos. The fields are keys in YAML files and options on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mvseg.detection.numbers import DETECTION
from mvseg.detectors import MAX_IMAGE_SIZE, MIN_IMAGE_SIZE
from mvseg.errors import check_choices, check_ranges


@dataclass(frozen=True)
class DetectConfig:
    """How leaves are found in the photos when no masks are given.

    Attributes:
        weights: name of a shipped detector (`mvseg models`), a model.safetensors that a training run wrote, or a result
            folder whose plant a detector has learned (`--learn`).
        min_probability: what is less likely a leaf is left out; in [0, 1]. The probability is calibrated: of leaves
            with 0.8 to 0.9, that part or more is right on plants that it was not fitted on (docs/detector.md). Null:
            where precision and recall of the leaves together are expected to be best, never above 0.5.
        min_score: proposals that score less are not matched at first; in [0, 1]. The score is the detector's confidence
            that it sees a leaf, times the expected IoU of its mask. Without `verify`, they are discarded.
        image_size: longer side, in pixels, that photos are scaled to. Null: larger photos are scaled down to the
            size given with the weights, smaller ones stay as they are; smaller sizes are tried, and the views decide.
        crop: auto: where the plant fills a small part of large photos, a second pass runs on their parts that show
            it: leaves are seen larger. off: one pass over whole photos.
        num_iterations: rounds of assignment to epipolar maps and NMS; 0 only matches what plain NMS keeps.
        verify: let the views choose leaves and masks from everything that the detector proposes, weak proposals
            included, by one score (`mvseg.verification.choose`). It was fitted on leaves.
    """

    weights: str = "leaf-lite"
    min_probability: float | None = None
    min_score: float = DETECTION.sure_score
    image_size: int | None = None
    crop: Literal["auto", "off"] = "auto"
    num_iterations: int = 1
    verify: bool = True

    def __post_init__(self) -> None:
        check_choices(self, "detect")
        check_ranges(self, "detect", min_score=(0, 1), min_probability=(0, 1), num_iterations=(0, math.inf))
        check_ranges(self, "detect", image_size=(MIN_IMAGE_SIZE, MAX_IMAGE_SIZE))
