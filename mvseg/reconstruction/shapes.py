"""Which shape an instance gets: a surface where there is a credible one, or else voxels."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.kept_surfaces import fit_kept
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid, reconstruct_instances
from mvseg.regions import Regions
from mvseg.scene import Cameras

Surfaces = Mapping[int, LeafSurface]
Voxels = Mapping[int, VoxelGrid]


def reconstruct_shapes(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    config: ReconstructConfig,
    starts: Surfaces = MappingProxyType({}),
    with_voxels: bool = True,
) -> tuple[Surfaces | None, Voxels]:
    """The shapes of all instances, as `config.shape` says.

    Args:
        regions: D regions.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        cameras: V cameras.
        config: what to make, and how.
        starts: instance id -> a surface that is nearly right, see `fit_surfaces`.
        with_voxels: False leaves voxels out, whatever the config says.

    Returns:
        {instance id: surface}, None with "voxels"; and {instance id: voxels}: of all instances with "voxels" or "both",
        of those without a credible surface with "surface". Their crumbs are dropped (`VoxelGrid.without_crumbs`).

    Raises:
        InputError: see `fit_surfaces` and `reconstruct_instances`.
    """
    surfaces = None
    if config.shape != "voxels":
        surfaces = fit_kept(regions, instance_ids, cameras, starts=starts)
        if not with_voxels:
            return surfaces, {}
        if config.shape == "surface":
            credible = [instance for instance, surface in surfaces.items() if surface.is_credible]
            instance_ids = instance_ids.where(~torch.isin(instance_ids, torch.tensor(credible).to(instance_ids)), -1)
            if not bool((instance_ids > 0).any()):
                return surfaces, {}
    voxels = reconstruct_instances(regions, instance_ids, cameras, config=config)
    return surfaces, {instance: grid.without_crumbs() for instance, grid in voxels.items()}


def best_shape(instance: int, surfaces: Surfaces | None, voxels: Voxels | None) -> LeafSurface | VoxelGrid | None:
    """The surface of an instance if it has a credible one, or else its voxels, or else None."""
    surface = (surfaces or {}).get(instance)
    return surface if surface is not None and surface.is_credible else (voxels or {}).get(instance)
