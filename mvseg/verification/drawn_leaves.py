"""Masks, in all other views, of the leaves that the user drew in two or more. Not in the paper.

Two outlines leave a surface's tilt open. Leaf-coloured free pixels of the other views close it: they belong to the leaf
where they contain projections of the hull of both outlines. The surface is fitted to those parts as well. Half masks of
the leaf, which the user did not draw, go: they would make it half a surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.crop import Crop
from mvseg.errors import collect_warnings
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.reconstruction.voxels import back_project
from mvseg.regions import Regions, stack_regions
from mvseg.scene import Cameras
from mvseg.verification.evidence import median_parallax
from mvseg.verification.leaf_color import has_leaf_color
from mvseg.verification.numbers import DRAWN, EVIDENCE
from mvseg.verification.picture import colors_of_leaves

Frame = NDArray[np.bool_]

HULL = ReconstructConfig(voxel_budget=25_000)  # of the volume that outlines allow; a limit of time
COLUMNS = ("view_index", "boxes", "crops", "labels")


def follow_drawn(
    masks: Masks,
    *,
    cameras: Cameras,
    photos: ReadPhoto | None,
    colors: Frame | None = None,
    cache: SurfaceCache | None = None,
) -> Masks:
    """Give the leaves that the user drew a mask in each other view that shows them openly.

    There, at least `DRAWN.least_visible` of the leaf's surface, and `EVIDENCE.open_pixels`, lie in no mask of another
    leaf, and `DRAWN.least_colored` of it have the colour of leaves. An unmatched mask that agrees with it
    (`EVIDENCE.fits`) becomes the leaf's; otherwise, that part does, with `Origin.OTHER_VIEWS`.

    Args:
        masks: D masks, matched; the user drew those with `Origin.CORRECTED`.
        photos: of the views. None: the outlines alone tell.
        colors: see `colors_of_leaves`; None: those of the masks.

    Returns:
        The D masks on the CPU in their order, without half masks (see `_drop_halves`), and the new ones after them.
    """
    masks, cameras = masks.to("cpu"), cameras.to("cpu")
    drawn = masks.instance_ids[(masks.origin == Origin.CORRECTED) & (masks.instance_ids > 0)].unique().tolist()
    followed = [leaf for leaf in drawn if _is_followed(masks, leaf)]
    if not followed or median_parallax(masks, cameras) < EVIDENCE.least_parallax:
        return masks
    colored = [np.ones((height, width), bool) for width, height in cameras.sizes.tolist()]
    if photos is not None:
        colors = colors_of_leaves(masks, photos) if colors is None else colors
        colored = [has_leaf_color(photos(view), colors) for view in range(len(cameras))]
    for leaf in followed:
        if photos is not None:
            masks = _drop_halves(masks, leaf, colored, cameras=cameras, cache=cache)
        if not _views_without(masks, leaf):
            continue
        surface = _fit(masks, leaf, colored if photos is not None else None, cameras=cameras, cache=cache)
        if surface.is_credible:
            masks = _show(masks, leaf, surface, cameras=cameras, colored=colored)
    return masks


def _is_followed(masks: Masks, leaf: int) -> bool:
    is_own = masks.instance_ids == leaf
    return bool(_views_without(masks, leaf)) or bool((is_own & ~masks.is_corrected & ~masks.is_linked).any())


def _views_without(masks: Masks, leaf: int) -> list[int]:
    shown = set(masks.view_index[masks.instance_ids == leaf].tolist())
    return [view for view in range(masks.regions.num_views) if view not in shown] if len(shown) > 1 else []


def _maybe_halves(masks: Masks, leaf: int, colored: list[Frame], *, cameras: Cameras) -> Tensor:
    """(D,) bool: masks that may show half a leaf: no user drew, confirmed or linked them, and enough more pixels have
    the colour of leaves and are in no mask of another leaf. None where the user drew the leaf in one view only.
    (Without such masks, no surface need be fitted.)"""
    is_own = masks.instance_ids == leaf
    maybe = is_own & ~masks.is_corrected & ~masks.is_linked
    if len(masks.view_index[is_own & (masks.origin == Origin.CORRECTED)].unique()) < 2:
        return maybe & False
    for row in maybe.nonzero()[:, 0].tolist():
        view, mask = int(masks.view_index[row]), masks.regions.placed(row)
        (x1, y1, x2, y2), (width, height) = mask.box, cameras.sizes[view].tolist()
        reach = max(x2 - x1, y2 - y1)  # on each side as much as there is
        near = slice(max(y1 - reach, 0), min(y2 + reach, height)), slice(max(x1 - reach, 0), min(x2 + reach, width))
        free = colored[view][near] & ~_others(masks, leaf, view, cameras).numpy()[near]
        maybe[row] = int(free.sum()) >= DRAWN.least_colored / DRAWN.half * mask.area
    return maybe


def _drop_halves(
    masks: Masks, leaf: int, colored: list[Frame], *, cameras: Cameras, cache: SurfaceCache | None
) -> Masks:
    """Drop masks that show half a leaf: the surface that follows from the outlines alone contains them, and the view
    shows more than twice as much of it openly, all in the colour of leaves."""
    maybe = _maybe_halves(masks, leaf, colored, cameras=cameras)
    if not maybe.any():
        return masks
    certain = (masks.instance_ids == leaf) & (masks.is_corrected | masks.is_linked)
    free = (masks.instance_ids == leaf) & ~certain
    alone = replace(masks, instance_ids=masks.instance_ids.where(~free, -1))
    surface = _fit(alone, leaf, colored, cameras=cameras, cache=cache)
    if not surface.is_credible:
        return masks
    shown = _find_open(alone, leaf, surface, cameras=cameras, colored=colored)
    stays = torch.ones(len(masks), dtype=torch.bool)
    for row in maybe.nonzero()[:, 0].tolist():
        if (found := shown.get(int(masks.view_index[row]))) is not None:
            mask, (visible, _) = masks.regions.placed(row), found
            stays[row] = not EVIDENCE.fits * mask.area <= mask.intersect(visible).area < DRAWN.half * visible.area
    return masks.select(stays)


def _fit(
    masks: Masks, leaf: int, colored: list[Frame] | None, *, cameras: Cameras, cache: SurfaceCache | None
) -> LeafSurface:
    """The surface of a leaf from its masks and, where they and the colours agree, from what may be its parts in the
    other views; all other masks may hide it."""
    regions = masks.regions
    alone = torch.where(masks.instance_ids == leaf, leaf, -1)
    own = regions.select(alone == leaf)

    def fit(parts: Mapping[int, Crop], start: LeafSurface | None) -> LeafSurface:
        ids = torch.cat((alone, torch.full((len(parts),), leaf)))
        more = _with_parts(regions, parts)
        starts = {} if start is None else {leaf: start}
        return fit_surfaces(more, ids, cameras, starts=starts, cache=cache)[leaf]

    others = _views_without(masks, leaf)
    if colored is None or not others:
        return fit({}, None)
    around = _shown_points(_with_hiding(masks, leaf, cameras), cameras, {view: colored[view] for view in others})
    rest = {view: colored[view] & ~_others(masks, leaf, view, cameras).numpy() for view in around}
    parts = _find_parts(rest, around)
    best = None
    for _ in range(DRAWN.rounds):
        if not parts:
            break
        best = fit(parts, best)
        if not best.exists:
            break
        parts = _find_parts(rest, _around(best, cameras, rest))
    if best is None or float(best.iou[torch.isin(best.views, own.view_index)].min()) < EVIDENCE.fits:
        best = fit({}, None)  # the outlines are certain
    return best


def _find_parts(remaining: Mapping[int, Frame], around: Mapping[int, Frame]) -> dict[int, Crop]:
    parts = {}
    for view in remaining:
        place = Crop.of(remaining[view] & around[view]) if (remaining[view] & around[view]).any() else None
        part = None if place is None else _largest_part(np.pad(place.pixels.numpy(), 1))[1:-1, 1:-1]
        if place is not None and part is not None and int(part.sum()) >= EVIDENCE.open_pixels:
            parts[view] = replace(place, pixels=torch.from_numpy(part.copy())).tighten()
    return parts


def _show(masks: Masks, leaf: int, surface: LeafSurface, *, cameras: Cameras, colored: list[Frame]) -> Masks:
    ids, parts = masks.instance_ids.clone(), {}
    for view, (visible, leaf_colored) in _find_open(masks, leaf, surface, cameras=cameras, colored=colored).items():
        is_free = (ids < 0) & ~masks.is_corrected & ~masks.is_linked  # a linked one does not show the leaf
        free = ((masks.view_index == view) & is_free).nonzero()[:, 0].tolist()
        fits = {row: masks.regions.placed(row).iou(visible) for row in free}
        best = max(fits, key=lambda row: fits[row], default=-1)
        if best >= 0 and fits[best] >= EVIDENCE.fits:
            ids[best] = leaf
        else:
            parts[view] = leaf_colored.tighten()
    first, count = int((ids == leaf).nonzero()[0, 0]), len(parts)
    regions = _with_parts(masks.regions.select(torch.zeros(0, dtype=torch.int64)), parts)
    new = Masks.of(regions, classes=masks.classes[first].repeat(count), origin=Origin.OTHER_VIEWS)
    least, score = min(int(masks.proposal.min()), 0), masks.match_scores[ids == leaf].mean()
    return replace(
        Masks.concatenate((masks, new)),
        instance_ids=torch.cat((ids, torch.full((count,), leaf))),
        match_scores=torch.cat((masks.match_scores, score.repeat(count))),
        proposal=torch.cat((masks.proposal, least - 1 - torch.arange(count))),
    )


def _find_open(
    masks: Masks, leaf: int, surface: LeafSurface, *, cameras: Cameras, colored: list[Frame]
) -> dict[int, tuple[Crop, Crop]]:
    """{view: the unhidden part of a leaf's surface, and what of it has the colour of leaves}, of the views without a
    mask of the leaf that show it openly."""
    places, open_views = surface.project_parts(cameras), {}
    for view in _views_without(masks, leaf):
        whole = places[view]
        visible = replace(whole, pixels=whole.pixels & ~whole.cut(_others(masks, leaf, view, cameras)))
        leaf_colored = replace(visible, pixels=visible.pixels & whole.cut(torch.from_numpy(colored[view])))
        is_open = visible.area >= max(EVIDENCE.open_pixels, DRAWN.least_visible * whole.area)
        if is_open and leaf_colored.area >= DRAWN.least_colored * visible.area:
            open_views[view] = visible, leaf_colored
    return open_views


def _others(masks: Masks, leaf: int, view: int, cameras: Cameras) -> Tensor:
    """(H, W) bool: masks of other instances, and masks without one that edits are about."""
    is_other = (masks.instance_ids != leaf) & ((masks.instance_ids > 0) | masks.is_corrected | masks.is_linked)
    width, height = cameras.sizes[view].tolist()
    return masks.regions.label_map(view, is_other.long(), (width, height)) > 0


def _with_hiding(masks: Masks, leaf: int, cameras: Cameras) -> Regions:
    """A region for each view with masks of a leaf: these, and others that touch them and may hide more of it."""
    hiding, regions = {}, masks.regions
    for view in masks.view_index[masks.instance_ids == leaf].unique().tolist():
        here = (masks.view_index == view).nonzero()[:, 0].tolist()
        size, is_leaf = tuple(cameras.sizes[view].tolist()), masks.instance_ids == leaf
        frame = regions.label_map(view, is_leaf.long(), size).numpy() > 0
        near = _dilate(frame, DRAWN.beside_px)
        others = [regions.placed(row) for row in here if not is_leaf[row]]
        hiding[view] = Crop.of(frame).union(*(each for each in others if (each.cut(near) & each.pixels.numpy()).any()))
    return _with_parts(regions.select(torch.zeros(0, dtype=torch.int64)), hiding)


def _shown_points(allowed: Regions, cameras: Cameras, colored: Mapping[int, Frame]) -> dict[int, Frame]:
    """{view: (H, W) bool} where the points come to lie that all regions `allowed` hold, and nearly all other views:
    these show leaf colour there."""
    with collect_warnings():  # masks whose common part is unbounded are cut off
        hull = back_project(allowed, cameras, config=HULL)
    if hull is None or not len(hull.points):
        return {}
    px, depth = cameras.project(hull.points.double())
    columns, rows = px.floor().long().clamp(-1, 2**30).numpy().transpose(2, 0, 1)
    against = np.zeros(len(hull.points), np.int64)
    places = {}
    for view, frame in colored.items():
        height, width = frame.shape
        column, row = columns[view], rows[view]
        is_inside = (column >= 0) & (row >= 0) & (column < width) & (row < height) & (depth[view].numpy() > 0)
        place = np.where(is_inside, row * width + column, 0)
        against += is_inside & ~_dilate(frame, DRAWN.beside_px).ravel()[place]
        places[view] = place, is_inside
    is_left = against <= max(1, DRAWN.most_against * len(colored))
    around = {}
    for view, (place, is_inside) in places.items():
        points = np.zeros(colored[view].shape, bool)
        points.ravel()[place[is_inside & is_left]] = True
        gap = float(hull.voxel_size * cameras.K[view, 0, 0] / depth[view].median().clamp(min=1e-9))
        around[view] = _dilate(points, int(np.ceil(gap)))
    return around


def _around(surface: LeafSurface, cameras: Cameras, frames: Mapping[int, Frame]) -> dict[int, Frame]:
    around = {}
    for view, part in enumerate(surface.project_parts(cameras)):
        if view in frames:
            height, width = frames[view].shape
            frame = part.paste((width, height)).numpy()
            around[view] = _dilate(frame, max(DRAWN.beside_px, round(DRAWN.reach * part.area**0.5)))
    return around


def _largest_part(frame: Frame) -> Frame:
    opened = cv2.morphologyEx(frame.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    if count < 2:
        return np.zeros_like(frame)
    largest: Frame = labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    return largest


def _dilate(frame: Frame, radius: int) -> Frame:
    kernel = np.ones((2 * radius + 1,) * 2, np.uint8)
    dilated: Frame = np.asarray(cv2.dilate(frame.astype(np.uint8), kernel)) > 0
    return dilated


def _with_parts(regions: Regions, parts: Mapping[int, Crop]) -> Regions:
    boxes, pixels = [each.box for each in parts.values()], [each.pixels.flatten() for each in parts.values()]
    new = stack_regions(list(parts), boxes, pixels, labels=[0] * len(boxes), num_views=regions.num_views)
    columns: dict[str, Any] = {name: torch.cat((getattr(regions, name), getattr(new, name))) for name in COLUMNS}
    return replace(regions, **columns)
