"""The masks of all views of a scene, with what the stages find out about each."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from mvseg.regions import Regions


@dataclass(frozen=True, eq=False)
class Proposals:
    """R scored masks of V views, many of them of the same object.

    Attributes:
        regions: the R masks as box crops, in the frame of the images.
        boxes: (R, 4) float32 xyxy in the frame of the images; what NMS compares.
        scores: (R,) float32.
        classes: (R,) int64; objects of different classes are never matched.
        from_views: (R,) bool, the masks that no detector found: the other views show them, see `hear_witnesses`. None
            where the other views were not heard.
    """

    regions: Regions
    boxes: Tensor
    scores: Tensor
    classes: Tensor
    from_views: Tensor | None = None

    def select(self, index: Tensor) -> Proposals:
        """The proposals at an int64 index, in that order."""
        return Proposals(
            regions=self.regions.select(index),
            boxes=self.boxes[index],
            scores=self.scores[index],
            classes=self.classes[index],
            from_views=None if self.from_views is None else self.from_views[index],
        )
