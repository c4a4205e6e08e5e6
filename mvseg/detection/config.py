"""How instances are found in photos. The fields are keys in YAML files and options on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvseg.errors import InputError

# pixels, as in a file of weights; this module is imported for --help, and loads no torch
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 16_384


@dataclass(frozen=True)
class DetectConfig:
    """How leaves are found in the photos when no masks are given.

    Attributes:
        weights: name of a shipped detector (`mvseg models`), or a model.safetensors that a training run wrote.
        min_score: detections that score less are discarded; in [0, 1]. The score is the detector's confidence that it
            sees a leaf, times the expected IoU of its mask.
        image_size: longer side, in pixels, that photos are scaled to. Null: larger photos are scaled down to the
            size given with the weights, smaller ones stay as they are; and where few masks are surely matched, as where
            leaves are very large, half of that is tried.
        crop: auto: where the plant fills a small part of large photos, a second pass runs on their parts that show
            it: leaves are seen larger. off: one pass over whole photos.
        num_iterations: rounds of assignment to epipolar maps and NMS; 0 only matches what plain NMS keeps.
        verify: let surfaces that are fitted to the matched masks correct them: the other views show which masks are
            no leaves or pieces of one, and which leaves were missed (`mvseg.verification.other_views`). Finds leaves:
            not for other things.
        min_views: of what verification leaves, a leaf must have masks in so many photos. 1 keeps, too, what one or two
            photos show and no other view verifies: as it was found, and marked.
    """

    weights: str = "leaf-lite"
    min_score: float = 0.3
    image_size: int | None = None
    crop: Literal["auto", "off"] = "auto"
    num_iterations: int = 1
    verify: bool = True
    min_views: int = 2

    def __post_init__(self) -> None:
        if not 0 <= self.min_score <= 1:
            raise InputError(f"detect.min_score is {self.min_score:g}, expected a number from 0 to 1")
        if self.image_size is not None and not MIN_IMAGE_SIZE <= self.image_size <= MAX_IMAGE_SIZE:
            expected = f"at least {MIN_IMAGE_SIZE}, at most {MAX_IMAGE_SIZE}"
            raise InputError(f"detect.image_size is {self.image_size}, expected {expected}")
        if self.num_iterations < 0:
            raise InputError(f"detect.num_iterations is {self.num_iterations}, expected 0 or more")
        if self.min_views < 1:
            raise InputError(f"detect.min_views is {self.min_views}, expected 1 or more")
