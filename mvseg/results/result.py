"""Everything known about one scene after a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.matching.result import Matching
from mvseg.poses.refine_poses import RefinedPoses
from mvseg.regions import Regions
from mvseg.scene import Scene

if TYPE_CHECKING:  # loads trimesh and scikit-image
    from mvseg.corrections.apply import Fate
    from mvseg.corrections.file import Corrections
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.traits.measure import Traits


@dataclass(frozen=True, eq=False)
class Result:
    """Everything known about one scene.

    Attributes:
        scene: the scene, with refined cameras where `poses` has them.
        matching: the table of its masks, undistorted, with their ids; and what matching says of the scene.
        photos: of the scene; None: they are read when they are needed.
        poses: outcome of their refinement; None if it was not requested.
        surfaces: {instance id: surface}, some of which may not be credible (`is_credible`); None if no surfaces were
            requested.
        voxels: {instance id: voxels}: of all instances if voxels were requested, otherwise of those without a credible
            surface; None for ids only.
        traits: of the plant and its leaves; None for ids only.
        seconds: {stage: wall time}.
        mask_kind: what the masks were read from ("COCO", "label images", ...); "" where a detector found them.
        corrections: of a person; None where there were none.
        fates: the outcome of each of their edits.
        num_moved: number of masks that the surfaces moved to another instance, see `check_ids`; None without that
            check.
    """

    scene: Scene
    matching: Matching
    photos: Photos | None = None
    poses: RefinedPoses | None = None
    surfaces: Mapping[int, LeafSurface] | None = None
    voxels: Mapping[int, VoxelGrid] | None = None
    traits: Traits | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    mask_kind: str = ""
    num_moved: int | None = None
    corrections: Corrections | None = None
    fates: tuple[Fate, ...] = ()

    @property
    def masks(self) -> Masks:
        """The table."""
        return self.matching.masks

    @property
    def regions(self) -> Regions:
        """D masks, undistorted."""
        return self.matching.masks.regions
