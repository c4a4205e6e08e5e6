"""How regions are matched. The fields are keys in YAML files and options on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mvseg.errors import InputError, check_choices, check_ranges


@dataclass(frozen=True)
class MatchConfig:
    """How regions are matched across views.

    Attributes:
        method: nview (weighs the evidence of all views at once; the most accurate), one-per-view (pairwise epipolar
            weights, at most one region per view in a cluster; the fastest), symnmf (the paper's), or auto: symnmf when
            the number of instances or a range for it is given, else nview.
        num_points: random pixels per region that send out epipolar lines (the paper: 200); null uses all pixels.
        num_instances: number of instances, if known; symnmf only, the other methods find it themselves.
        search_range: smallest and largest number of instances to try, as in [5, 9]; null for [m, 2 m], m being the
            largest number of masks in any view. Choose it with care: clusters of equal size always look good. symnmf
            only.
        num_restarts: random starts per factorisation; symnmf only.
        seed: for the random pixels and starts.
    """

    method: Literal["auto", "nview", "one-per-view", "symnmf"] = "auto"
    num_points: int | None = None
    num_instances: int | None = None
    search_range: tuple[int, int] | None = None
    num_restarts: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        check_choices(self, "match")
        at_least_1 = (1, math.inf)
        check_ranges(self, "match", num_points=at_least_1, num_instances=at_least_1, num_restarts=at_least_1)
        check_ranges(self, "match", seed=(0, 2**32 - 1))
        if self.method in ("nview", "one-per-view") and (self.num_instances or self.search_range):
            raise InputError(f"match.num_instances and match.search_range are for symnmf, not for {self.method}")
        if self.search_range is not None and not 1 <= self.search_range[0] <= self.search_range[1]:
            low, high = self.search_range
            raise InputError(f"match.search_range is [{low}, {high}], expected 1 <= smallest <= largest")

    @property
    def resolved_method(self) -> Literal["nview", "one-per-view", "symnmf"]:
        """The method, with "auto" decided."""
        if self.method != "auto":
            return self.method
        return "symnmf" if self.num_instances or self.search_range else "nview"
