"""Instances that are parts of one leaf become one. Not in the paper.

Where something crosses a leaf, masks on either side may form an instance each, and neither lies in the other's surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import cKDTree
from torch import Tensor

from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.evidence import Ints
from mvseg.verification.numbers import PARTS

Surfaces = Mapping[int, LeafSurface]


def join_halves(regions: Regions, ids: Ints, surfaces: Surfaces, *, cameras: Cameras) -> Ints:
    """Instances that are parts of one leaf get one id.

    A credible surface of an instance that few views show is doubted where it touches another one. Two masks in one
    photo speak for two leaves: one photo may split a leaf by accident, several do so only where masks are often in
    pieces (`PARTS.often_split`). If no more than that speaks against it, and one surface that is fitted to the masks of
    both fits them as well as two do (`fits_as_well`), they are the same leaf. All join the one of them with most masks.

    Args:
        regions: D regions on the CPU.
        ids: (D,) from 1 on; -1 = no instance.
        surfaces: {instance id: surface} of those that may be joined.
        cameras: V cameras.
    """
    shown = {instance: each for instance, each in surfaces.items() if each.exists and (ids == instance).any()}
    few = [part for part in seen_rarely(regions, ids) if part in shown and shown[part].is_credible]
    touching = {(part, whole) for part in few if (whole := touched_surface(part, shown))}
    counts, leaves = _count_masks(regions, ids), DisjointSet(np.unique(ids).tolist())
    is_often_split = (counts > 1).sum() >= PARTS.often_split * (counts > 0).sum()
    for pair in sorted({(min(pair), max(pair)) for pair in touching}):
        may_be = is_often_split or (counts[list(pair)] > 0).all(0).sum() <= PARTS.most_split
        if may_be and _is_one_leaf(regions, ids, pair, surfaces=shown, cameras=cameras):
            leaves.merge(*pair)
    joined = ids.copy()
    for parts in leaves.subsets():
        joined[np.isin(ids, list(parts))] = max(sorted(parts), key=lambda part: (ids == part).sum())
    return joined


def seen_rarely(regions: Regions, ids: Ints) -> list[int]:
    """The instances that at most `PARTS.few_views` of the views show, in ascending order."""
    num_views = (_count_masks(regions, ids) > 0).sum(1)
    rarely: list[int] = np.flatnonzero((num_views > 0) & (num_views <= PARTS.few_views * regions.num_views)).tolist()
    return rarely


def _count_masks(regions: Regions, ids: Ints) -> Ints:
    """(N + 1, V) how many masks of each instance each view shows."""
    counts = np.zeros((1 + max(0, int(ids.max(initial=0))), regions.num_views), np.int64)
    np.add.at(counts, (ids[ids > 0], regions.view_index.numpy()[ids > 0]), 1)
    return counts


def touched_surface(part: int, surfaces: Surfaces) -> int | None:
    """The nearest of the other surfaces, if it touches this one."""
    points = {instance: surface.points().reshape(-1, 3).numpy() for instance, surface in surfaces.items()}
    tree = cKDTree(points.pop(part))
    gaps = {instance: float(tree.query(there)[0].min()) for instance, there in points.items()}
    nearest = min(gaps, key=lambda instance: gaps[instance], default=None)
    return nearest if nearest is not None and gaps[nearest] <= PARTS.touches * surfaces[part].length else None


def are_one_leaf(regions: Regions, ids: Tensor, surfaces: Surfaces, *, cameras: Cameras) -> bool:
    """Whether the instances 1 and 2 of D regions, `ids` (D,) int64, touch, and one surface shows both as well as their
    own do. A person has said so: neither has to be seen rarely, and many photos may show both."""
    shown = {instance: each for instance, each in surfaces.items() if each.exists}
    touches = len(shown) == 2 and touched_surface(1, shown) == 2
    return touches and _is_one_leaf(regions, ids.numpy(), (1, 2), surfaces=shown, cameras=cameras)


def _is_one_leaf(regions: Regions, ids: Ints, pair: tuple[int, int], *, surfaces: Surfaces, cameras: Cameras) -> bool:
    """Does one surface fit the masks of two instances as well as their own surfaces do?"""
    joint = fit_surfaces(regions, torch.from_numpy(np.where(np.isin(ids, pair), 1, -1)), cameras)[1]
    return fits_as_well(joint, [surfaces[instance] for instance in pair])


def fits_as_well(joint: LeafSurface, parts: Sequence[LeafSurface]) -> bool:
    """Whether it is credible, its median IoU that of the worst of the parts or more, and its outline as near to those
    of the masks.

    The IoU alone would forgive a larger surface: outlines that are as uncertain take a smaller share of it.
    """
    worst = min(float(part.iou.median()) for part in parts)
    farthest = max(_outline_px(part) for part in parts)
    return joint.is_credible and float(joint.iou.median()) >= worst and _outline_px(joint) <= PARTS.as_near * farthest


def _outline_px(surface: LeafSurface) -> float:
    """Root mean square distance between its outline and those of its masks, over the views with both."""
    return float(surface.residual_px.square().nanmean().sqrt())
