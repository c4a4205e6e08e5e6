"""Masks, in all other views, of the leaves that the user drew in two or more. Not in the paper.

Two outlines leave a surface's tilt open. Leaf-coloured free pixels of the other views close it: they belong to the leaf
where they contain projections of the hull of both outlines. The surface is fitted to those parts as well. Half masks of
the leaf, which the user did not draw, go: they would make it half a surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from mvseg.arrays import Bools
from mvseg.crop import Crop
from mvseg.errors import collect_warnings
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import Cache
from mvseg.reconstruction.voxels import back_project
from mvseg.regions import Regions, stack_regions
from mvseg.scene import Cameras
from mvseg.verification.evidence import median_parallax
from mvseg.verification.leaf_color import has_leaf_color
from mvseg.verification.numbers import DRAWN, EVIDENCE
from mvseg.verification.picture import colors_of_leaves

HULL = ReconstructConfig(voxel_budget=25_000)  # of the volume that outlines allow; a limit of time


def follow_drawn(
    masks: Masks,
    *,
    cameras: Cameras,
    photos: ReadPhoto,
    colors: Bools | None = None,
    cache: Cache | None = None,
) -> Masks:
    """Give the leaves that the user drew a mask in each other view that shows them openly.

    There, at least `DRAWN.least_visible` of the leaf's surface, and `EVIDENCE.open_pixels`, lie in no mask of another
    leaf, and `DRAWN.least_colored` of it have the colour of leaves. An unmatched mask that agrees with it
    (`EVIDENCE.fits`) becomes the leaf's; otherwise, that part does, with `Origin.OTHER_VIEWS`.

    Args:
        masks: D masks, matched; the user drew those with `Origin.CORRECTED`.
        colors: see `colors_of_leaves`; None: those of the masks.

    Returns:
        The D masks on the CPU in their order, without half masks (see `_drop_halves`), and the new ones after them.
    """
    masks, cameras = masks.to("cpu"), cameras.to("cpu")
    drawn = masks.instance_ids[(masks.origin == Origin.CORRECTED) & (masks.instance_ids > 0)].unique().tolist()
    leaves = [_DrawnLeaf(masks, leaf, cameras, (), cache) for leaf in drawn]
    followed = [each.leaf for each in leaves if each.views_without or (each.is_own & ~masks.is_edited).any()]
    if not followed or median_parallax(masks, cameras) < EVIDENCE.least_parallax:
        return masks
    colors = colors_of_leaves(masks, photos) if colors is None else colors
    colored = tuple(has_leaf_color(photos(view), colors) for view in range(len(cameras)))
    for leaf in followed:
        drawn_leaf = _drop_halves(_DrawnLeaf(masks, leaf, cameras, colored, cache))
        masks = drawn_leaf.masks
        if drawn_leaf.views_without and (surface := _fit(drawn_leaf)).is_credible:
            masks = _show(drawn_leaf, surface)
    return masks


@dataclass(frozen=True, eq=False)
class _DrawnLeaf:
    """One leaf among D masks; `colored`: V frames (H, W) of leaf colour."""

    masks: Masks
    leaf: int
    cameras: Cameras
    colored: tuple[Bools, ...]
    cache: Cache | None

    @property
    def is_own(self) -> Tensor:
        return self.masks.instance_ids == self.leaf

    @cached_property
    def views_without(self) -> list[int]:
        """The views without a mask of it; none where one view alone has one."""
        views = set(self.masks.view_index[self.is_own].tolist())
        return [view for view in range(len(self.cameras)) if view not in views] if len(views) > 1 else []

    def others(self, view: int) -> Bools:
        """(H, W) masks of other leaves, and masks without one that edits are about."""
        is_other = ~self.is_own & ((self.masks.instance_ids > 0) | self.masks.is_edited)
        height, width = self.colored[view].shape
        return np.asarray(self.masks.regions.label_map(view, is_other.long(), (width, height)).numpy() > 0)

    def find_open(self, surface: LeafSurface) -> dict[int, tuple[Crop, Crop]]:
        """{view: the unhidden part of the surface, and what of it has leaf colour}, of the views without a mask of the
        leaf that show it openly."""
        places, open_views = surface.project_parts(self.cameras), {}
        for view in self.views_without:
            whole = places[view]
            visible = replace(whole, pixels=whole.pixels & ~whole.cut(torch.from_numpy(self.others(view))))
            leaf_colored = replace(visible, pixels=visible.pixels & whole.cut(torch.from_numpy(self.colored[view])))
            is_open = visible.area >= max(EVIDENCE.open_pixels, DRAWN.least_visible * whole.area)
            if is_open and leaf_colored.area >= DRAWN.least_colored * visible.area:
                open_views[view] = visible, leaf_colored
        return open_views


def _drop_halves(drawn: _DrawnLeaf) -> _DrawnLeaf:
    """Drop masks that show half a leaf, which the user drew in two views or more: the surface that follows from the
    outlines alone contains them, and the view shows more than twice as much of it openly, all in leaf colour."""
    masks, is_free = drawn.masks, drawn.is_own & ~drawn.masks.is_edited
    views = masks.view_index[drawn.is_own & (masks.origin == Origin.CORRECTED)].unique()
    if len(views) < 2 or not is_free.any():
        return drawn
    alone = replace(drawn, masks=replace(masks, instance_ids=masks.instance_ids.where(~is_free, -1)))
    surface = _fit(alone)
    open_views = alone.find_open(surface) if surface.is_credible else {}
    stays = torch.ones(len(masks), dtype=torch.bool)
    for row in is_free.nonzero()[:, 0].tolist():
        mask = masks.regions.placed(row)
        for visible, _ in filter(None, [open_views.get(int(masks.view_index[row]))]):
            stays[row] = not EVIDENCE.fits * mask.area <= mask.intersect(visible).area < DRAWN.half * visible.area
    return replace(drawn, masks=masks.select(stays))


def _fit(drawn: _DrawnLeaf) -> LeafSurface:
    """The surface of a leaf from its masks and, where they and the colours agree, from what may be its parts in the
    other views; all other masks may hide it."""
    regions, cameras, leaf = drawn.masks.regions, drawn.cameras, drawn.leaf
    alone = torch.where(drawn.is_own, leaf, -1)

    def fit(parts: Mapping[int, Crop]) -> LeafSurface:
        ids = torch.cat((alone, torch.full((len(parts),), leaf)))
        return fit_surfaces(_with_parts(regions, parts), ids, cameras, cache=drawn.cache)[leaf]

    free = {view: drawn.colored[view] & ~drawn.others(view) for view in drawn.views_without}
    parts = _find_parts(free, _project_hull(drawn)) if free else {}
    best, views = fit(parts), regions.view_index[drawn.is_own]
    is_right = best.exists and float(best.iou[torch.isin(best.views, views)].min()) >= EVIDENCE.fits
    return best if is_right or not parts else fit({})  # the outlines are certain


def _find_parts(free: Mapping[int, Bools], around: Mapping[int, Bools]) -> dict[int, Crop]:
    """{view: the largest part of its free pixels around the leaf}, of `EVIDENCE.open_pixels` or more."""
    parts, kernel = {}, np.ones((3, 3), np.uint8)
    for view, frame in around.items():
        part = (free[view] & frame).astype(np.uint8)
        opened = cv2.morphologyEx(part, cv2.MORPH_OPEN, kernel, borderValue=0)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
        largest = stats[1:, cv2.CC_STAT_AREA].argmax() + 1 if count > 1 else 0
        if largest and stats[largest, cv2.CC_STAT_AREA] >= EVIDENCE.open_pixels:
            parts[view] = Crop.of(labels == largest)
    return parts


def _show(drawn: _DrawnLeaf, surface: LeafSurface) -> Masks:
    masks, leaf, parts = drawn.masks, drawn.leaf, dict[int, Crop]()
    ids = masks.instance_ids.clone()
    for view, (visible, leaf_colored) in drawn.find_open(surface).items():
        is_free = (masks.view_index == view) & (ids < 0) & ~masks.is_edited  # a linked one does not show the leaf
        fits = {row: masks.regions.placed(row).iou(visible) for row in is_free.nonzero()[:, 0].tolist()}
        best = max(fits, key=lambda row: fits[row], default=-1)
        if best >= 0 and fits[best] >= EVIDENCE.fits:
            ids[best] = leaf
        else:
            parts[view] = leaf_colored.tighten()
    first, count = int((ids == leaf).nonzero()[0, 0]), len(parts)
    regions = _with_parts(masks.regions.select(ids < -1), parts)
    new = Masks.of(regions, classes=masks.classes[first].repeat(count), origin=Origin.OTHER_VIEWS)
    least, score = min(int(masks.proposal.min()), 0), masks.match_scores[ids == leaf].mean()
    return replace(
        Masks.concatenate((masks, new)),
        instance_ids=torch.cat((ids, torch.full((count,), leaf))),
        match_scores=torch.cat((masks.match_scores, score.repeat(count))),
        proposal=torch.cat((masks.proposal, least - 1 - torch.arange(count))),
    )


def _project_hull(drawn: _DrawnLeaf) -> dict[int, Bools]:
    """{view without a mask of the leaf: (H, W) where the points come to lie that all its masks allow}."""
    with collect_warnings():  # masks whose common part is unbounded are cut off
        hull = back_project(drawn.masks.regions.select(drawn.is_own), drawn.cameras, config=HULL)
    if hull is None or not len(hull.points):
        return {}
    px, depth = drawn.cameras.project(hull.points.double())
    around = {}
    for view in drawn.views_without:
        (height, width), (column, row) = drawn.colored[view].shape, px[view].floor().long().unbind(1)
        is_inside = (column >= 0) & (row >= 0) & (column < width) & (row < height) & (depth[view] > 0)
        points = torch.zeros((height, width), dtype=torch.uint8)
        points[row[is_inside], column[is_inside]] = 1
        gap = float(hull.voxel_size * drawn.cameras.K[view, 0, 0] / depth[view].median().clamp(min=1e-9))
        around[view] = cv2.dilate(points.numpy(), np.ones((2 * int(np.ceil(gap)) + 1,) * 2, np.uint8)) > 0
    return around


def _with_parts(regions: Regions, parts: Mapping[int, Crop]) -> Regions:
    new = stack_regions([(view, each, 0) for view, each in parts.items()], regions.num_views)
    return Regions.concatenate((regions, new))
