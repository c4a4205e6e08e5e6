"""The user who says that two halves show one leaf says so of all photos. Not in the paper.

Where masks show a leaf in two halves in many photos, each half is an instance of its own. A link would join the two
linked masks, and leave the others to either half.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mvseg.corrections.corrected import Corrected
from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.masks import Masks
from mvseg.matching.links import Links
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras


def link_halves(corrected: Corrected, ids: Tensor, cameras: Cameras) -> Corrected:
    """The masks as edits leave them, with the links that follow between halves of a leaf.

    A link that joins masks of two instances is about all of their masks where several photos show both, and one surface
    shows the masks of both as well as two do (`are_one_leaf`): then both are linked in each of these photos. Elsewhere
    it says that one mask has the wrong id, and the two instances are two leaves.

    Args:
        corrected: D masks and their links.
        ids: (D,) int64, the leaves that they showed before the edits.

    Returns:
        The same with more links; a link that would contradict those of the user is left out.
    """
    masks, links = corrected.masks, corrected.links
    if not len(links.must):
        return corrected
    is_linked = masks.is_linked
    for one, other in sorted({(min(pair), max(pair)) for pair in ids[links.must].tolist()}):
        halves = _in_one_photo(masks, ids == one, ids == other) if 0 < one < other else []
        if len({int(masks.view_index[row]) for row, _ in halves}) < EDITS.least_halves:
            continue
        own = torch.where(ids == one, 1, torch.where(ids == other, 2, -1))
        if are_one_leaf(masks.regions, own, cameras):
            more = Links(torch.cat((links.must, torch.tensor(halves))), links.cannot)
            with suppress(InputError):
                more.components(len(masks))
                links, is_linked = more, is_linked | Links.of(halves).named(len(masks))
    return replace(corrected, links=links, masks=replace(masks, is_linked=is_linked))


def are_one_leaf(regions: Regions, ids: Tensor, cameras: Cameras) -> bool:
    """Whether the surfaces of the instances 1 and 2 of D regions, `ids` (D,) int64, touch, and one surface shows the
    masks of both as well as their own do."""
    parts = fit_surfaces(regions, ids, cameras)
    if not all(each.exists for each in parts.values()):
        return False
    joint = fit_surfaces(regions, ids.clamp(max=1), cameras)[1]
    return _touches(parts[1], parts[2]) and fits_as_well(joint, [parts[1], parts[2]])


def _touches(one: LeafSurface, other: LeafSurface) -> bool:
    points, tree = one.points().reshape(-1, 3).numpy(), cKDTree(other.points().reshape(-1, 3).numpy())
    return float(tree.query(points)[0].min()) <= EDITS.touches * one.length


def fits_as_well(joint: LeafSurface, parts: Sequence[LeafSurface]) -> bool:
    """Whether it is credible, its median IoU that of the worst of the parts or more, and its outline as near to those
    of the masks.

    The IoU alone would forgive a larger surface: outlines that are as uncertain take a smaller share of it.
    """
    worst = min(float(part.iou.median()) for part in parts)
    farthest = max(_outline_px(part) for part in parts)
    return joint.is_credible and float(joint.iou.median()) >= worst and _outline_px(joint) <= EDITS.as_near * farthest


def _outline_px(surface: LeafSurface) -> float:
    """Root mean square distance between its outline and those of its masks, over the views with both."""
    return float(surface.residual_px.square().nanmean().sqrt())


def _in_one_photo(masks: Masks, is_one: Tensor, is_other: Tensor) -> list[tuple[int, int]]:
    first, second = is_one.nonzero()[:, 0].tolist(), is_other.nonzero()[:, 0].tolist()
    views = masks.view_index.tolist()
    return [(row, other) for row in first for other in second if views[row] == views[other]]
