"""Matchings made by hand."""

from __future__ import annotations

import torch
from torch import Tensor

from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions


def matched(regions: Regions, ids: Tensor | None = None, scores: Tensor | float = 0.9) -> Matching:
    """As nview gives it: these ids (default: the regions' labels), all as sure as that."""
    ids = regions.labels if ids is None else ids
    scores = torch.where(ids > 0, scores, 0.0) if isinstance(scores, float) else scores
    return Matching(Masks.of(regions, ids, scores), MatchReport("nview", has_probabilities=True))
