"""Stands in for what a detector finds: masks that are matched whatever is asked, and the excessive set."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class FoundMasks:
    """As `mvseg.detection.detect_scene.Found`."""

    matching: Matching
    excessive: Masks

    @staticmethod
    def of(matching: Matching) -> Any:
        """The masks of a matching are all there is: their labels become rows of the excessive set."""
        masks = matching.masks
        numbered = replace(masks, regions=replace(masks.regions, labels=torch.arange(len(masks))))
        numbered = replace(numbered, origin=torch.full_like(masks.origin, Origin.DETECTED))
        return FoundMasks(matching.with_masks(numbered), numbered)

    def match(self, cameras: Cameras) -> Matching:
        return self.matching

    def match_more(self, cameras: Cameras) -> tuple[Masks, ...]:
        return (self.matching.masks,)

    def proposals(self, cameras: Cameras) -> Masks:
        return self.excessive
