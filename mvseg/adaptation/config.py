"""How a detector is adapted. The fields are keys in YAML files and options on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mvseg.errors import InputError


@dataclass(frozen=True)
class AdaptConfig:
    """How the photos of known cameras teach the detector that looks at them.

    Attributes:
        min_match_score: least probability that a label's id is right.
        min_views: in how many views an instance must be seen, surely matched, for its masks to be labels; all views
            where there are fewer.
        num_samples: how many times a photo is trained on, over all photos. 300 take some five minutes on two cores.
        lr: peak learning rate, see `TrainConfig`.
        image_size: training samples are windows of this many pixels, cut from photos at the size of the detection.
        seed: of everything random.
    """

    min_match_score: float = 0.5
    min_views: int = 4
    num_samples: int = 300
    lr: float = 4e-4
    image_size: int = 448
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.min_match_score <= 1:
            raise InputError(f"adapt.min_match_score is {self.min_match_score:g}, expected a number from 0 to 1")
        for name, least in (("min_views", 2), ("num_samples", 1), ("image_size", 32), ("seed", 0)):
            if getattr(self, name) < least:
                raise InputError(f"adapt.{name} is {getattr(self, name)}, expected at least {least}")
        if not 0 < self.lr < math.inf:
            raise InputError(f"adapt.lr is {self.lr:g}, expected a positive number")
