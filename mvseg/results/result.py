"""Everything known about one scene after a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from torch import Tensor

from mvseg.matching.result import Matching
from mvseg.regions import Regions
from mvseg.scene import Scene

if TYPE_CHECKING:  # loads trimesh and scikit-image
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.traits.measure import Traits


@dataclass(frozen=True, eq=False)
class Result:
    """Everything known about one scene.

    Attributes:
        scene: the scene.
        regions: D masks, undistorted.
        matching: their ids.
        surfaces: {instance id: surface}, some of which may not be credible (`is_credible`); None when no surfaces were
            asked for.
        voxels: {instance id: voxels}: of all instances where voxels were asked for, otherwise of those without a
            credible surface; None when only ids were asked for.
        traits: of the plant and its leaves; None when only ids were asked for.
        seconds: {stage: wall time}.
        detection_scores: (D,) float32, the detector's score of each mask; None when the masks were given.
        from_other_views: (D,) bool, masks that no detector found: the other views show that a leaf is there; None where
            masks were given, or the other views were not asked.
        mask_kind: what the masks were read from ("COCO", "label images", ...); "" where a detector found them.
        num_moved: how many masks got another id from the surfaces, see `check_ids`; None where they were not asked.
    """

    scene: Scene
    regions: Regions
    matching: Matching
    surfaces: Mapping[int, LeafSurface] | None = None
    voxels: Mapping[int, VoxelGrid] | None = None
    traits: Traits | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    detection_scores: Tensor | None = None
    from_other_views: Tensor | None = None
    mask_kind: str = ""
    num_moved: int | None = None
