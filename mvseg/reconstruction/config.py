"""How instances become shapes. The fields are keys in YAML files and options on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mvseg.errors import InputError, check_choices, check_ranges


@dataclass(frozen=True)
class ReconstructConfig:
    """How instances become shapes.

    Attributes:
        shape: surface (a spline surface fitted to the outlines of the masks, with area, length, width and angles, see
            docs/surfaces.md; an instance without a credible one gets voxels), voxels (Eq. 6, a closed shape with a
            volume) or both. The other options but `check_ids` are about voxels.
        threshold: a voxel belongs to an instance when more than this share of the instance's masks contains it (the
            paper: 0.5); in [0, 1).
        seen_share: keeps thin instances thin: of the instance's views with a clear line of sight to a voxel (its pixel
            shows this instance, or no instance at all), more than this share must show the instance. A view in which
            another instance may hide the voxel does not count; unmasked objects (stems, missed leaves) hide nothing. In
            [0, 1); 0 is the paper's rule, which leaves thin instances thick.
        voxel_size: edge of a voxel in the scene's unit; null to derive it from the budget.
        voxel_budget: number of voxels in an instance's bounding box when no size is given.
        check_ids: masks that fit the surface of another instance better get its id, surfaces whose masks changed are
            fitted again, and masks that show two surfaces are listed, see docs/matching.md; not where masks are
            verified (`detect.verify`), nor without surfaces.
    """

    shape: Literal["surface", "voxels", "both"] = "surface"
    threshold: float = 0.5
    seen_share: float = 0.8
    voxel_size: float | None = None
    voxel_budget: int = 250_000
    check_ids: bool = True

    def __post_init__(self) -> None:
        check_choices(self, "reconstruct")
        check_ranges(self, "reconstruct", voxel_budget=(1, math.inf))
        for name, share in (("threshold", self.threshold), ("seen_share", self.seen_share)):
            if not 0 <= share < 1:
                raise InputError(f"reconstruct.{name} is {share:g}, expected a number in [0, 1)")
        if self.voxel_size is not None and not 0 < self.voxel_size < float("inf"):
            raise InputError(f"reconstruct.voxel_size is {self.voxel_size:g}, expected a positive number")
