"""Semantic segmentation in 3D (Sec. 4.3): back-projection of the union of all masks, without any matching."""

from __future__ import annotations

from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.voxels import VoxelGrid, back_project
from mvseg.regions import Regions
from mvseg.scene import Scene


def reconstruct_semantic(
    regions: Regions, scene: Scene, config: ReconstructConfig = ReconstructConfig()
) -> VoxelGrid | None:
    """The voxels of all leaves together: "we unified the silhouettes of all leaves" (Sec. 4.3).

    A voxel is occupied when, of the views that show any leaf, more than a share of `config.threshold` have a mask
    there. Give a voxel size to compare with instances: the voxel budget is for the whole plant here. None when fewer
    than two views show anything, or no point has enough votes. Raises InputError: see `back_project`.
    """
    return back_project(regions, scene.cameras, config=config)
