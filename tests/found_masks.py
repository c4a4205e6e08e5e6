"""Stands in for what a detector sees: masks that are matched whatever is asked, and the excessive set."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from mvseg.config import RunConfig
from mvseg.formats.photos import Photos
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching
from mvseg.pipeline.open_scene import Opened
from mvseg.scene import Scene


@dataclass(frozen=True, eq=False)
class FoundMasks:
    """As `mvseg.detection.detect_scene.Pass`."""

    sure: Matching
    excessive: Masks
    more: Masks | None = None
    boxes: torch.Tensor | None = None
    longest: int = 32

    @staticmethod
    def of(matching: Matching) -> Any:
        """The masks of a matching are all there is: their labels become rows of the excessive set."""
        masks = matching.masks
        numbered = replace(masks, regions=replace(masks.regions, labels=torch.arange(len(masks))))
        numbered = replace(numbered, origin=torch.full_like(masks.origin, Origin.DETECTED))
        return FoundMasks(matching.with_masks(numbered), numbered)

    def match(self, min_score: float) -> Matching:
        return self.sure.with_masks(self.more or self.sure.masks)

    def proposals(self) -> Masks:
        return self.excessive


def open_photos(scene: Scene, config: RunConfig = RunConfig(), given: Masks | None = None) -> Opened:
    """A scene in memory, as `open_scene` opens one."""
    return Opened(scene, Photos(scene), config, given=given)


def see_masks(monkeypatch: Any, look: Any) -> None:
    """The detector sees this look in every scene."""
    monkeypatch.setattr("mvseg.pipeline.find_in_photos.detect_scene", lambda *_, **__: look)
