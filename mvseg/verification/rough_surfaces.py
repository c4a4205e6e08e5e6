"""Surfaces to judge masks by: fitted once, to few views, and none where the cameras see the leaves from one side."""

from __future__ import annotations

import torch

from mvseg.errors import collect_warnings
from mvseg.masks import Masks
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.scene import Cameras
from mvseg.verification.numbers import ROUGH


def fit_roughly(masks: Masks, cameras: Cameras, cache: SurfaceCache | None = None) -> dict[int, LeafSurface]:
    """{instance id: surface} to verify masks with. Nothing is warned of: the final fits warn."""
    with collect_warnings():
        return fit_surfaces(
            masks.regions, masks.instance_ids, cameras, most_views=ROUGH.views, is_rough=True, cache=cache
        )


def median_parallax(masks: Masks, cameras: Cameras) -> float:
    """Degrees; median over the instances of the largest angle between two lines of sight to their masks; infinite
    without an instance that two views show."""
    boxes = masks.regions.boxes.double()
    centres = torch.cat((boxes[:, :2] + boxes[:, 2:], torch.full_like(boxes[:, :1], 2)), 1) / 2
    sights = (cameras.world_from_px[masks.view_index] @ centres[:, :, None])[..., 0]
    sights = sights / sights.norm(dim=1, keepdim=True)
    angles = []
    for instance in masks.instance_ids[masks.instance_ids > 0].unique().tolist():
        own = sights[masks.instance_ids == instance]
        if len(own) > 1:
            angles.append(torch.rad2deg(torch.acos((own @ own.T).clamp(-1, 1)).max()))
    return float(torch.stack(angles).median()) if angles else float("inf")
