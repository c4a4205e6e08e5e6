"""Extend a link between two halves of a leaf to all photos. Not in the paper.

Where masks show a leaf in two halves in many photos, each half is an instance of its own.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import torch
from torch import Tensor

from mvseg.corrections.corrected import Corrected
from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.matching.links import Links
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.joined_halves import shows_both, touch
from mvseg.verification.numbers import CHOICE


def link_halves(corrected: Corrected, ids: Tensor, cameras: Cameras) -> Corrected:
    """Link the halves of a leaf (`are_one_leaf`) in each photo that shows both, if a link joins masks of the two
    instances.

    Elsewhere the link says that one mask has the wrong id, and the two instances are two leaves. A link that would
    contradict those of the user is left out. `ids` (D,) int64: the leaves before the edits."""
    masks, links = corrected.masks, corrected.links
    if not len(links.must):
        return corrected
    is_linked = masks.is_linked
    for one, other in sorted({(min(pair), max(pair)) for pair in ids[links.must].tolist()}):
        own = torch.where(ids == one, 1, torch.where(ids == other, 2, -1))
        is_pair = (own[:, None] == 1) & (own == 2) & (masks.view_index[:, None] == masks.view_index)
        halves = is_pair.nonzero()
        if not 0 < one < other or len(masks.view_index[halves[:, 0]].unique()) < CHOICE.least_views:
            continue
        if are_one_leaf(masks.regions, own, cameras):
            more = Links(torch.cat((links.must, halves)), links.cannot)
            with suppress(InputError):
                more.components(len(masks))
                links, is_linked = more, is_linked | Links.of(halves.tolist()).named(len(masks))
    return replace(corrected, links=links, masks=replace(masks, is_linked=is_linked))


def are_one_leaf(regions: Regions, ids: Tensor, cameras: Cameras) -> bool:
    """Whether the surfaces of the instances 1 and 2 of D regions, `ids` (D,) int64, touch, and one surface shows the
    masks of both as well as their own do, with an outline as near to them: the IoU alone would forgive a larger one."""
    halves = fit_surfaces(regions, ids, cameras).values()
    if not all(each.exists for each in halves) or not touch(*halves):
        return False
    surface = fit_surfaces(regions, ids.clamp(max=1), cameras)[1]
    is_near = _outline_px(surface) <= EDITS.as_near * max(map(_outline_px, halves))
    return surface.is_credible and shows_both(surface, halves, fits=1.0) and is_near


def _outline_px(surface: LeafSurface) -> float:
    """Root mean square distance between its outline and those of its masks, over the views with both."""
    return float(surface.residual_px.square().nanmean().sqrt())
