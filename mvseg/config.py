"""What a run can be told: frozen dataclasses; their fields are the keys of the YAML files and the command line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MatchConfig:
    """How regions are matched across views.

    Attributes:
        num_points: random pixels per region that send out epipolar lines (the paper: 200); null takes all pixels.
        num_instances: number of instances, when it is known.
        search_range: smallest and largest number of instances to try; null for [m, 2 m], m the largest number of
            masks in any view. See mvseg/clustering.py for why it decides everything.
        num_restarts: random starts of each factorisation.
        seed: of the random pixels and starts.
    """

    num_points: int | None = None
    num_instances: int | None = None
    search_range: tuple[int, int] | None = None
    num_restarts: int = 2
    seed: int = 0


@dataclass(frozen=True)
class ReconstructConfig:
    """How instances become voxels.

    Attributes:
        threshold: a voxel belongs to an instance when more than this share of the instance's masks contains it (the
            paper: 0.5); in [0, 1).
        voxel_size: edge of a voxel in the scene's unit; null to derive it from the budget.
        voxel_budget: voxels in an instance's bounding box when no size is given.
    """

    threshold: float = 0.5
    voxel_size: float | None = None
    voxel_budget: int = 250_000
