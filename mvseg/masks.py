"""The one table: the masks of all views of a scene, a row each, with what the stages find out about them.

A stage takes `Masks` and gives `Masks` back; nothing about a mask is kept anywhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

import torch
from torch import Tensor

from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.regions import Regions, stack_regions
from mvseg.table import Table

STEM_CLASS = 2  # definition: class of given masks of stems; leaves have 1
SURE = 0.5  # definition: match score, or q, from which a mask likelier shows an instance than not


class Origin(IntEnum):
    """Source of a mask."""

    GIVEN = 0  # the user's
    DETECTED = 1
    OTHER_VIEWS = 2  # no detector found it: surfaces fitted to the masks of other views show it
    CORRECTED = 3  # the user drew it; from here on, no stage changes or drops a mask
    CUT = 4  # the user cut it from another one
    CONFIRMED = 5  # the user says that it is right, with the edge that photos give it


@dataclass(frozen=True, eq=False, repr=False)
class Masks(Table):
    """D masks in V views.

    Attributes:
        regions: view, box and crop of each.
        instance_ids: (D,) int64, the same number in [1, K] for masks of one instance; -1 = matched to nothing.
        match_scores: (D,) float32 in [0, 1], see `Matching.match_scores`.
        detection_scores: (D,) float32, the detector's; NaN for masks that no detector scored.
        classes: (D,) int64; masks of different classes are never matched.
        origin: (D,) int64, of `Origin`.
        is_linked: (D,) bool, the user says which other masks show its instance, or do not.
        proposal: (D,) int64, its row among the proposals of its plant; below 0: edits or other views made it.

    Raises:
        InputError: columns of other lengths than there are regions.
    """

    regions: Regions
    instance_ids: Tensor
    match_scores: Tensor
    detection_scores: Tensor
    classes: Tensor
    origin: Tensor
    is_linked: Tensor
    proposal: Tensor

    def __repr__(self) -> str:
        return f"Masks({len(self)} in {self.regions.num_views} views, of {self.num_instances} instances)"

    def __post_init__(self) -> None:
        first, *lengths = map(len, self.columns.values())
        if {first, *lengths} != {first}:
            raise InputError(f"{first} regions with columns of {lengths} rows, expected one row each")

    @staticmethod
    def of(
        regions: Regions,
        instance_ids: Tensor | None = None,
        match_scores: Tensor | None = None,
        *,
        detection_scores: Tensor | None = None,
        classes: Tensor | None = None,
        origin: Origin = Origin.GIVEN,
    ) -> Masks:
        """The table of these regions; by default they are matched to nothing, unscored, of class 1, and proposals."""
        count, device = len(regions), regions.device
        integer = torch.ones(count, dtype=torch.int64, device=device)
        return Masks(
            regions=regions,
            instance_ids=-integer if instance_ids is None else instance_ids,
            match_scores=torch.zeros(count, device=device) if match_scores is None else match_scores,
            detection_scores=integer * torch.nan if detection_scores is None else detection_scores,
            classes=integer if classes is None else classes,
            origin=int(origin) * integer,
            is_linked=integer < 0,
            proposal=torch.arange(count, device=device),
        )

    @property
    def view_index(self) -> Tensor:
        """(D,) int64, the view of each."""
        return self.regions.view_index

    @property
    def is_corrected(self) -> Tensor:
        """(D,) bool: the user drew, cut or confirmed it."""
        return self.origin >= Origin.CORRECTED

    @property
    def is_edited(self) -> Tensor:
        """(D,) bool: an edit is about it."""
        return self.is_corrected | self.is_linked

    @property
    def num_instances(self) -> int:
        """K, the largest id."""
        return max(int(self.instance_ids.max()), 0) if len(self) else 0

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of one or more tables of the same views, one after another.

        No instance is shared by two parts: the ids of each follow those of the parts before it.
        """
        shifted, largest = [], 0
        for part in parts:
            ids = torch.where(part.instance_ids > 0, part.instance_ids + largest, -1)
            shifted.append(replace(part, instance_ids=ids))
            largest += part.num_instances
        return super().concatenate(shifted)

    def count_sure_views(self) -> Tensor:
        """(K,) int64: in how many views a mask of each instance has a match score of at least 0.5."""
        is_sure = (self.instance_ids > 0) & (self.match_scores >= SURE)
        seen = torch.zeros(self.num_instances, self.regions.num_views, dtype=torch.int64, device=self.view_index.device)
        seen[self.instance_ids[is_sure] - 1, self.view_index[is_sure]] = 1
        return seen.sum(1)


def replace_crops(masks: Masks, crops: Sequence[Crop]) -> Masks:
    """The same D rows with other pixels, on the CPU."""
    rows = zip(masks.view_index.tolist(), crops, masks.regions.labels.tolist(), strict=True)
    return replace(masks.to("cpu"), regions=stack_regions([*rows], masks.regions.num_views))
