"""Choice of the shape of an instance: a surface where there is a credible one, or else voxels."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid, reconstruct_instances
from mvseg.regions import Regions
from mvseg.scene import Cameras

Surfaces = Mapping[int, LeafSurface]
Voxels = Mapping[int, VoxelGrid]


def reconstruct_voxels(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    config: ReconstructConfig,
    surfaces: Surfaces | None = None,
) -> Voxels:
    """{instance id: voxels} of the instances that need them: of all where `config.shape` is "voxels" or "both", of
    those without a credible surface where it is "surface". Their crumbs are dropped (`VoxelGrid.without_crumbs`).

    `instance_ids` (D,) int64 are from 1 on; -1 = no instance. Raises as `reconstruct_instances` does.
    """
    if config.shape == "surface":
        credible = [instance for instance, surface in (surfaces or {}).items() if surface.is_credible]
        instance_ids = instance_ids.where(~torch.isin(instance_ids, torch.tensor(credible).to(instance_ids)), -1)
        if not bool((instance_ids > 0).any()):
            return {}
    voxels = reconstruct_instances(regions, instance_ids, cameras, config=config)
    return {instance: grid.without_crumbs() for instance, grid in voxels.items()}


def best_shape(instance: int, surfaces: Surfaces | None, voxels: Voxels | None) -> LeafSurface | VoxelGrid | None:
    """The surface of an instance if it has a credible one, or else its voxels, or else None."""
    surface = (surfaces or {}).get(instance)
    return surface if surface is not None and surface.is_credible else (voxels or {}).get(instance)
