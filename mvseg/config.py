"""What a run can be told: frozen dataclasses; their fields are the keys of the YAML files and the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvseg.errors import InputError


@dataclass(frozen=True)
class MatchConfig:
    """How regions are matched across views.

    Attributes:
        method: nview (what all views must agree on; the strongest), one-per-view (the epipolar weights, no two regions
            of a view in one cluster; the quickest), symnmf (the paper's), or auto: nview, but symnmf when the number of
            instances or a range for it is given.
        num_points: random pixels per region that send out epipolar lines (the paper: 200); null takes all pixels.
        num_instances: number of instances, when it is known; symnmf only, the others find it by themselves.
        search_range: smallest and largest number of instances to try, as in [5, 9]; null for [m, 2 m], m the largest
            number of masks in any view. Where the search starts decides much: equal parts always look good. symnmf
            only.
        num_restarts: random starts of each factorisation of symnmf.
        seed: of the random pixels and starts.
        split_merged: cut a mask that seems to cover two instances in two, in the results of `mvseg infer` and `match`.
    """

    method: Literal["auto", "nview", "one-per-view", "symnmf"] = "auto"
    num_points: int | None = None
    num_instances: int | None = None
    search_range: tuple[int, int] | None = None
    num_restarts: int = 2
    seed: int = 0
    split_merged: bool = False

    def __post_init__(self) -> None:
        for name in ("num_points", "num_instances", "num_restarts"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"match.{name} is {value}, expected at least 1")
        if self.method in ("nview", "one-per-view") and (self.num_instances or self.search_range):
            raise InputError(f"match.num_instances and match.search_range are for symnmf, not for {self.method}")
        if self.search_range is not None and not 1 <= self.search_range[0] <= self.search_range[1]:
            low, high = self.search_range
            raise InputError(f"match.search_range is [{low}, {high}], expected 1 <= smallest <= largest")
        if not 0 <= self.seed < 2**32:
            raise InputError(f"match.seed is {self.seed}, expected a number from 0 to 2^32 - 1")


@dataclass(frozen=True)
class DetectConfig:
    """How leaves are found in the photos when no masks are given.

    Attributes:
        weights: name of a shipped detector (`mvseg models`), or a model.safetensors that a training run wrote.
        min_score: detections that score less are dropped; in [0, 1]. A score is how sure the detector is that it sees a
            leaf, times the IoU that its mask is expected to have.
        image_size: longer side, in pixels, that photos are scaled to. Null: larger photos are scaled down to what the
            weights say, smaller ones stay as they are.
        num_iterations: of assignment to epipolar maps and NMS; 0 only matches what plain NMS leaves.
    """

    weights: str = "leaf-slim"
    min_score: float = 0.3
    image_size: int | None = None
    num_iterations: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.min_score <= 1:
            raise InputError(f"detect.min_score is {self.min_score:g}, expected a number from 0 to 1")
        if self.image_size is not None and self.image_size < 32:
            raise InputError(f"detect.image_size is {self.image_size}, expected at least 32")
        if self.num_iterations < 0:
            raise InputError(f"detect.num_iterations is {self.num_iterations}, expected 0 or more")


@dataclass(frozen=True)
class ReconstructConfig:
    """How instances become voxels.

    Attributes:
        threshold: a voxel belongs to an instance when more than this share of the instance's masks contains it (the
            paper: 0.5); in [0, 1).
        seen_share: against matter around thin instances: of the instance's views whose pixel shows the instance or
            no instance at all, more than this share must show the instance. A view in which another instance may stand
            in front of the voxel does not count; what has no mask (stems, leaves that were missed) counts as none. In
            [0, 1); 0 is the paper's rule, which leaves thin things thick.
        voxel_size: edge of a voxel in the scene's unit; null to derive it from the budget.
        voxel_budget: voxels in an instance's bounding box when no size is given.
    """

    threshold: float = 0.5
    seen_share: float = 0.8
    voxel_size: float | None = None
    voxel_budget: int = 250_000

    def __post_init__(self) -> None:
        if not 0 <= self.threshold < 1:
            raise InputError(f"reconstruct.threshold is {self.threshold:g}, expected a number in [0, 1)")
        if not 0 <= self.seen_share < 1:
            raise InputError(f"reconstruct.seen_share is {self.seen_share:g}, expected a number in [0, 1)")
        if self.voxel_size is not None and not 0 < self.voxel_size < float("inf"):
            raise InputError(f"reconstruct.voxel_size is {self.voxel_size:g}, expected a positive number")
        if self.voxel_budget < 1:
            raise InputError(f"reconstruct.voxel_budget is {self.voxel_budget}, expected at least 1")
