"""Choice of the instances that count as leaves; fields of `TraitsConfig` are YAML keys and command line options."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mvseg.errors import check_choices, check_ranges

Up = tuple[float, float, float] | Literal["rig", "board"]  # the direction that points up, or what shows it


@dataclass(frozen=True)
class TraitsConfig:
    """Choice of the instances that count as leaves; the others keep shapes and ids, and the table gives the reason.

    Attributes:
        min_sure_views: views with a sure match (match score of 0.5 or more) that a leaf needs; it has no effect where
            the matcher gives no probabilities.
        min_quality: least median IoU of a leaf's surface with its masks; in [0, 1]. Leaves that have voxels only are
            not judged by it.
        min_visible_share: of the pixels that a leaf's surface covers in the photos, its masks must cover this share; in
            [0, 1]. A surface that is hardly visible in any photo is in the wrong place.
        leaves_only: leave out what looks like a stem: slender for its plant.
        stems: auto: find the stems that the leaves sit on, with their nodes (docs/traits.md), where leaves and photos
            agree about them; off: do not look for any.
    """

    min_sure_views: int = 2
    min_quality: float = 0.5
    min_visible_share: float = 0.05
    leaves_only: bool = True
    stems: Literal["auto", "off"] = "auto"

    def __post_init__(self) -> None:
        check_choices(self, "traits")
        check_ranges(self, "traits", min_sure_views=(0, math.inf), min_quality=(0, 1), min_visible_share=(0, 1))
