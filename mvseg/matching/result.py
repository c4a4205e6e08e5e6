"""What region matching returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvseg.masks import Masks


@dataclass(frozen=True, eq=False)
class MatchReport:
    """Outcome of matching for the scene as a whole.

    Attributes:
        method: what produced the ids: "nview", "one-per-view" (also what nview falls back to when there are only two
            views or the views do not agree), "symnmf", or the name of a baseline.
        has_probabilities: whether match scores are probabilities; "nview" gives them.
        residual_px: reprojection error of the matched masks, in pixels; None where it was not estimated.
        explained: mean score of the matched masks in their clusters; 1 = every pixel is seen in all other views. None
            where it was not estimated.
        view_explained: (V,) float32, the same of each view's matched masks; NaN for a view without any.
    """

    method: str
    has_probabilities: bool = False
    residual_px: int | None = None
    explained: float | None = None
    view_explained: Tensor | None = None

    @staticmethod
    def join(reports: Sequence[MatchReport], weights: Sequence[int]) -> MatchReport:
        """Join reports of masks that were matched class by class; `weights`: the matched masks of each part.

        The method is that of the first part, the residual the largest, the explained share the mean over the matched
        masks, or over the parts; None where a part has none.
        """
        residuals = [each.residual_px for each in reports if each.residual_px is not None]
        shares = [each.explained * n for each, n in zip(reports, weights, strict=True) if each.explained is not None]
        views = [each.view_explained for each in reports if each.view_explained is not None]
        return MatchReport(
            method=reports[0].method,
            has_probabilities=all(each.has_probabilities for each in reports),
            residual_px=max(residuals) if len(residuals) == len(reports) else None,
            explained=sum(shares) / max(sum(weights), 1) if len(shares) == len(reports) else None,
            view_explained=torch.stack(views).nanmean(0) if len(views) == len(reports) else None,
        )


@dataclass(frozen=True, eq=False)
class Matching:
    """Assignment of D masks to K instances, and a report on the scene.

    Attributes:
        masks: the table.
        report: of the scene.
    """

    masks: Masks
    report: MatchReport

    def __len__(self) -> int:
        return len(self.masks)

    @property
    def instance_ids(self) -> Tensor:
        """(D,) int64; masks of one instance share a number in [1, K]; -1 = matched to nothing."""
        return self.masks.instance_ids

    @property
    def match_scores(self) -> Tensor:
        """(D,) float32 in [0, 1]. Where "nview" was asked for, the probability that the id is right, as fitted on
        simulated plants. Otherwise the mean affinity (Eq. 3) of a mask to the members of its cluster in other views. 0
        for a mask that is matched to nothing or alone in its cluster."""
        return self.masks.match_scores

    @property
    def num_instances(self) -> int:
        """K."""
        return self.masks.num_instances

    @property
    def support(self) -> Tensor | None:
        """(K,) int64, number of views in which each instance, from id 1 on, has a mask with a match score of at least
        0.5; None where the match scores are not probabilities."""
        return self.masks.count_sure_views() if self.report.has_probabilities else None

    def with_masks(self, masks: Masks) -> Matching:
        """The same report with another state of the table."""
        return replace(self, masks=masks)
