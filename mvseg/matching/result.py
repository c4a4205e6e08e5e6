"""What region matching returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvseg.errors import InputError
from mvseg.scene import Cameras

SURE = 0.5  # match score from which a region counts for its instance's support


@dataclass(frozen=True, eq=False)
class MergedMask:
    """A mask that seems to cover two instances.

    Attributes:
        region: its index.
        own: id of the instance that it was matched to.
        other: id of the second instance.
        part: (h, w) bool on the CPU, the pixels of the region's box that show the second instance.
    """

    region: int
    own: int
    other: int
    part: Tensor


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """What came of refining the poses with the masks.

    Attributes:
        cameras: V cameras, the given ones unless they are refined.
        is_refined: whether refined poses were taken.
        gap_px: by how many pixels outlines of one leaf miss the same epipolar lines, with the poses as given, and with
            poses refined without that leaf; NaN where no leaf tells.
    """

    cameras: Cameras
    is_refined: bool
    gap_px: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Matching:
    """Which of D regions shows which of K instances.

    Attributes:
        instance_ids: (D,) int64; regions of one instance share a number in [1, K]; -1 = matched to nothing.
        match_scores: (D,) float32 in [0, 1]. Where "nview" was asked for, the probability that the id is right, as
            fitted on simulated plants. Otherwise the mean affinity (Eq. 3) of a region to the members of its cluster in
            other views. 0 for a region that is matched to nothing or alone in its cluster.
        num_instances: K.
        method: what produced the ids: "nview", "one-per-view" (also what nview falls back to when there are only two
            views or the views do not agree), "symnmf", or the name of a baseline.
        support: (K,) int64, number of views in which each instance, from id 1 on, has a region with a match score of at
            least 0.5; None where the match scores are not probabilities.
        merged: masks that seem to cover two instances. The masks themselves are unchanged (`split_merged` cuts them).
            "nview" looks for them, and `mvseg infer` asks the surfaces, see docs/matching.md.
        residual_px: reprojection error of the matched regions, in pixels; None where it was not estimated.
        explained: mean score of the matched regions in their clusters; 1 = every pixel is seen in all other views. None
            where it was not estimated.
        view_explained: (V,) float32, the same of each view's matched regions; NaN for a view without any.
        poses: the cameras that the ids come from, where `MatchConfig.refine_poses` asked for better ones.
    """

    instance_ids: Tensor
    match_scores: Tensor
    num_instances: int
    method: str
    support: Tensor | None = None
    merged: tuple[MergedMask, ...] = ()
    residual_px: int | None = None
    explained: float | None = None
    view_explained: Tensor | None = None
    poses: RefinedPoses | None = None

    def __len__(self) -> int:
        return len(self.instance_ids)

    def to(self, device: torch.device | str) -> Matching:
        support = None if self.support is None else self.support.to(device)
        views = None if self.view_explained is None else self.view_explained.to(device)
        ids, scores = self.instance_ids.to(device), self.match_scores.to(device)
        poses = None if self.poses is None else replace(self.poses, cameras=self.poses.cameras.to(device))
        return replace(self, instance_ids=ids, match_scores=scores, support=support, view_explained=views, poses=poses)

    def select(self, index: Tensor) -> Matching:
        """The regions at an int64 index, in that order. All instances stay, even those without regions."""
        merged_of = {mask.region: mask for mask in self.merged}
        chosen = [(new, merged_of[region]) for new, region in enumerate(index.tolist()) if region in merged_of]
        return replace(
            self,
            instance_ids=self.instance_ids[index],
            match_scores=self.match_scores[index],
            merged=tuple(replace(mask, region=new) for new, mask in chosen),
        )

    def reorder(self, positions: Tensor) -> Matching:
        """Region n becomes region `positions[n]`, the inverse of `select`; `positions` (D,) is a permutation."""
        return self.select(positions.argsort())

    def relabel(self, numbers: Tensor) -> Matching:
        """Instance k gets the id `numbers[k - 1]`.

        Args:
            numbers: (K,) int64: 1, 2, ... in any order, each once, and -1 for every instance to discard: its regions
                become unmatched, and merged masks that involve it are forgotten.

        Raises:
            InputError: any other numbers.
        """
        kept = int((numbers > 0).sum())
        expected = [-1] * (self.num_instances - kept) + list(range(1, kept + 1))
        if sorted(numbers.tolist()) != expected:
            message = f"{self.num_instances} instances get the numbers {numbers.tolist()}"
            raise InputError(f"{message}, expected 1, 2, ... once each, or -1")
        lookup = torch.cat((numbers.to(self.instance_ids), self.instance_ids.new_tensor([-1])))
        ids = lookup[torch.where(self.instance_ids > 0, self.instance_ids - 1, len(numbers))]
        support = self.support
        if support is not None:
            support = support[lookup[:-1].argsort(stable=True)[len(numbers) - kept :]]
        number = [0, *numbers.tolist()]
        merged = [replace(mask, own=number[mask.own], other=number[mask.other]) for mask in self.merged]
        return replace(
            self,
            instance_ids=ids,
            match_scores=self.match_scores * (ids > 0),
            num_instances=kept,
            support=support,
            merged=tuple(mask for mask in merged if min(mask.own, mask.other) > 0),
        )

    @staticmethod
    def concatenate(parts: Sequence[Matching]) -> Matching:
        """The regions and instances of one or more matchings, one after another.

        No instance is shared by two parts: the ids of each part follow those of the parts before it. The method is that
        of the first part. Support, residual (the largest) and explained share (the mean over the matched regions; of
        each view, over the parts) are None when a part has none; `poses` are None.
        """
        ids, merged = [], []
        num_regions = num_instances = 0
        for part in parts:
            ids.append(torch.where(part.instance_ids > 0, part.instance_ids + num_instances, -1))
            for mask in part.merged:
                own, other = mask.own + num_instances, mask.other + num_instances
                merged.append(replace(mask, region=mask.region + num_regions, own=own, other=other))
            num_regions += len(part)
            num_instances += part.num_instances
        supports = [part.support for part in parts if part.support is not None]
        residuals = [part.residual_px for part in parts if part.residual_px is not None]
        weights = [int((part.instance_ids > 0).sum()) for part in parts]
        shares = [part.explained * n for part, n in zip(parts, weights, strict=True) if part.explained is not None]
        views = [part.view_explained for part in parts if part.view_explained is not None]
        return Matching(
            instance_ids=torch.cat(ids),
            match_scores=torch.cat([part.match_scores for part in parts]),
            num_instances=num_instances,
            method=parts[0].method,
            support=torch.cat(supports) if len(supports) == len(parts) else None,
            merged=tuple(merged),
            residual_px=max(residuals) if len(residuals) == len(parts) else None,
            explained=sum(shares) / max(sum(weights), 1) if len(shares) == len(parts) else None,
            view_explained=torch.stack(views).nanmean(0) if len(views) == len(parts) else None,
        )


def count_sure_views(matching: Matching, view_index: Tensor) -> Tensor:
    """(K,) int64: in how many views a region of each instance has a match score of at least 0.5.

    `view_index` (D,) int64 is the view of each region.
    """
    num_views = int(view_index.max()) + 1 if len(view_index) else 0
    is_sure = (matching.instance_ids > 0) & (matching.match_scores >= SURE)
    seen = torch.zeros(matching.num_instances, num_views, dtype=torch.int64, device=view_index.device)
    seen[matching.instance_ids[is_sure] - 1, view_index[is_sure]] = 1
    return seen.sum(1)
