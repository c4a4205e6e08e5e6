"""Surfaces check the ids: masks that show another instance's surface get its id. Not in the paper.

Rays and epipolar lines know nothing of shape. A surface that is fitted to an instance's masks in all views says what
each view must show of it. So it recognises its masks where they were matched to another instance, and the pieces of
its leaf where leaves that cross it made several masks of one. And where two instances are halves of one leaf, one
surface explains the masks of both. Where two surfaces explain one mask in disjoint parts, it shows two leaves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvseg.masks import SURE, Masks, MergedMask
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.evidence import FITS, Bools, Ints, Shown, paint_view
from mvseg.verification.rematched_masks import rematch_misfits

Surfaces = Mapping[int, LeafSurface]

VIEWS_TO_CHECK = 5  # sure ids stay where there are fewer views: surfaces fit wrong masks about as well as right ones
FEW_VIEWS = 0.75  # an instance may be made of pieces if at most this fraction of the views shows it
PIECE_INSIDE = 0.8  # a mask may be a piece of a leaf if at least this fraction of it lies in what is seen of the leaf
AS_NEAR = 1.1  # one surface fits as well as two if its outline is at most so many times as far off as theirs
EACH, BOTH = 0.2, 0.7  # a mask shows two leaves if at least these fractions of it show each of them, and both together


def check_ids(
    masks: Masks,
    surfaces: Surfaces,
    *,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
) -> Masks:
    """Move masks to the instances whose surfaces they show.

    First the pieces (`move_pieces`), then the masks that fit another surface than their own (`move_misfits`), then the
    halves of leaves (`join_halves`). What still lies outside its own surface is matched once more (`rematch_misfits`).
    No mask loses its id without getting another. An instance may have several masks in a view afterwards: they show it
    together. With fewer than `VIEWS_TO_CHECK` views, masks that are surely matched stay. Last, the masks that show two
    surfaces are marked as merged (`find_shared`).

    Args:
        masks: D masks; those that are merged and move are forgotten to be so, unless they show two surfaces. Those that
            a person corrected or linked keep their ids, and their instances are joined with none.
        surfaces: {instance id: surface} fitted to them, of every instance that has one.
        cameras: V cameras.
        config: that the masks were matched with.

    Returns:
        The same masks. Those that moved to a surface have the mean match score of those that had its id before, those
        that were matched once more have that score. Instances that lost all their masks leave gaps between the ids.
    """
    on_cpu, cameras = masks.regions.to("cpu"), cameras.to("cpu")
    old, shown = masks.instance_ids.cpu().numpy(), Shown.of(on_cpu, surfaces, cameras)
    is_held: Bools = (masks.is_corrected | masks.is_linked).cpu().numpy()
    if masks.regions.num_views < VIEWS_TO_CHECK:
        is_held = is_held | (masks.match_scores >= SURE).cpu().numpy()
    ids = np.where(is_held, old, move_pieces(on_cpu, old, shown))
    left = {instance: surface for instance, surface in surfaces.items() if (ids == instance).any()}
    ids = np.where(is_held, old, move_misfits(on_cpu, ids, shown))
    certain = {*old[is_held].tolist()}
    ids = join_halves(on_cpu, ids, {k: each for k, each in left.items() if k not in certain}, cameras=cameras)
    checked = _with_ids(masks, ids)
    known = unchanged_surfaces(masks, checked, left)
    free = torch.from_numpy(~is_held)
    checked = rematch_misfits(checked, known, shown=shown, cameras=cameras, free=free, config=config)
    ids = checked.instance_ids.cpu().numpy()
    merged = {each.region: each for each in checked.merged}
    left = {instance: surface for instance, surface in left.items() if (ids == instance).any()}
    shared = find_shared(on_cpu, ids, left, shown=shown, cameras=cameras, named=list(merged.values()))
    merged |= {each.region: each for each in shared}
    return checked.with_merged(merged.values())


def _with_ids(masks: Masks, ids: Ints) -> Masks:
    """The masks with these ids (D,); what moved has the mean match score of those that had the id before."""
    old = masks.instance_ids.cpu().numpy()
    is_moved = ids != old
    scores = masks.match_scores.clone()
    for instance in np.unique(ids[is_moved]).tolist():
        others = torch.from_numpy((old == instance) & ~is_moved)
        others = others if others.any() else torch.from_numpy(old == instance)
        moved = torch.from_numpy(is_moved & (ids == instance))
        scores[moved.to(scores.device)] = masks.match_scores[others.to(scores.device)].mean()
    merged = [each for each in masks.merged if not is_moved[each.region] and (ids == each.other).any()]
    with_ids = replace(masks, instance_ids=torch.from_numpy(ids).to(masks.instance_ids), match_scores=scores)
    return with_ids.with_merged(merged)


def unchanged_surfaces(before: Masks, after: Masks, surfaces: Surfaces) -> dict[int, LeafSurface]:
    """The surfaces of the instances that have the same of D masks before and after."""
    changed = torch.cat([masks.instance_ids[before.instance_ids != after.instance_ids] for masks in (before, after)])
    gone = set(changed.tolist())
    return {instance: surface for instance, surface in surfaces.items() if instance not in gone}


def move_pieces(regions: Regions, ids: Ints, shown: Shown) -> Ints:
    """Masks of instances that are made of pieces of leaves get the ids of these leaves.

    Where leaves cross, each piece may have a mask of its own, and pieces found in several views form instances of their
    own, with surfaces that lie in those of the leaves. So the surfaces of instances that few views show are left out,
    and those of all others drawn. An instance of few views most of whose masks lie in one of these, which need not
    be the same for all, is made of pieces: those masks join the leaves that they lie in.

    Args:
        regions: D regions on the CPU.
        ids: (D,) from 1 on; -1 = no instance.
        shown: what the views show of them and of the surfaces.

    Returns:
        (D,) ids.
    """
    few = _seen_rarely(regions, ids)
    inside = shown.compare(set(shown.instances.tolist()) - set(few)).inside
    is_inside = inside.max(1) >= PIECE_INSIDE
    revised = ids.copy()
    for instance in few:
        own = ids == instance
        if 2 * (own & is_inside).sum() > own.sum():
            revised[own & is_inside] = inside[own & is_inside].argmax(1)
    return revised


def move_misfits(regions: Regions, ids: Ints, shown: Shown) -> Ints:
    """Masks that do not fit their own surface, but another one, get its id; for the arguments see `move_pieces`.

    The IoU with the visible part of their own must be below `FITS`, that with the other at least `FITS`, and no other
    mask of the view may fit that one as well. Two masks with each other's ids are swapped so. A mask that is already
    there and fits worse stays.
    """
    present = set(ids.tolist()) & set(shown.instances.tolist())
    ious, every = shown.compare(present).visible, np.arange(len(ids))
    own_column = np.where(np.isin(ids, list(present)), ids, 0)
    best = ious.argmax(1)
    best_iou, own_iou = ious[every, best], ious[every, own_column]
    wants = np.flatnonzero((own_iou < FITS) & (best_iou >= FITS))
    revised = ids.copy()
    for region in wants.tolist():
        rivals = (regions.view_index == regions.view_index[region]).numpy() & (every != region)
        if not (ious[rivals, best[region]] >= best_iou[region]).any():
            revised[region] = best[region]
    return revised


def join_halves(regions: Regions, ids: Ints, surfaces: Surfaces, *, cameras: Cameras) -> Ints:
    """Instances that are parts of one leaf become one; for the arguments see `move_pieces`.

    Where something crosses a leaf, masks on either side may form an instance each, and neither lies in the other's
    surface. So a credible surface of an instance that few views show is held against the nearest other one: if one
    surface that is fitted to the masks of both fits them as well as two do (`fits_as_well`), they are the same leaf.
    All join the one of them that has most masks.
    """
    shown = {instance: each for instance, each in surfaces.items() if each.exists and (ids == instance).any()}
    few = [part for part in _seen_rarely(regions, ids) if part in shown and shown[part].is_credible]
    nearest = {(part, whole) for part in few if (whole := nearest_surface(part, shown))}
    pairs = [
        pair for pair in sorted({(min(pair), max(pair)) for pair in nearest})
        if _is_one_leaf(regions, ids, pair, surfaces=shown, cameras=cameras)
    ]  # fmt: skip
    if not pairs:
        return ids
    part, whole = np.array(pairs).T
    size = int(ids.max()) + 1
    _, leaf = connected_components(coo_array((np.ones(len(part)), (part, whole)), shape=(size, size)), directed=False)
    num_masks = np.bincount(ids[ids > 0], minlength=size)
    largest = np.array([np.where(leaf == number, num_masks, -1).argmax() for number in range(leaf.max() + 1)])
    return np.where(ids > 0, largest[leaf[ids]], ids)


def _seen_rarely(regions: Regions, ids: Ints) -> list[int]:
    """The instances that at most `FEW_VIEWS` of the views show, in ascending order."""
    views, most = regions.view_index.numpy(), FEW_VIEWS * regions.num_views
    return [number for number in np.unique(ids[ids > 0]).tolist() if len(np.unique(views[ids == number])) <= most]


def nearest_surface(part: int, surfaces: Surfaces) -> int | None:
    """Of the other surfaces, the one that comes nearest to this one; None without any."""
    points = {instance: surface.points().reshape(-1, 3).numpy() for instance, surface in surfaces.items()}
    tree = cKDTree(points.pop(part))
    gaps = {instance: float(tree.query(there)[0].min()) for instance, there in points.items()}
    return min(gaps, key=lambda instance: gaps[instance], default=None)


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
    return joint.is_credible and float(joint.iou.median()) >= worst and _outline_px(joint) <= AS_NEAR * farthest


def _outline_px(surface: LeafSurface) -> float:
    """Root mean square distance between its outline and those of its masks, over the views with both."""
    return float(surface.residual_px.square().nanmean().sqrt())


def find_shared(
    regions: Regions, ids: Ints, surfaces: Surfaces, *, shown: Shown, cameras: Cameras, named: Iterable[MergedMask] = ()
) -> list[MergedMask]:
    """Masks that two surfaces explain in disjoint parts: their own, and of all others the one that explains most.

    Half of what the view shows of the second one must lie in the mask, or the matcher must have `named` the two: a
    mask that is drawn too large, or a surface that is drawn over another by mistake, shows a strip of it only. The
    second part is what is nearer to what is seen of the second surface than to what is seen of the first. For the other
    arguments see `move_pieces`.
    """
    inside, every = shown.compare(surfaces).inside, np.arange(len(ids))
    own = np.where(np.isin(ids, shown.instances), ids, 0)  # others have no surface, and no column
    by_own = inside[every, own]
    inside[every, own] = 0
    second, by_second = inside.argmax(1), inside.max(1)
    is_explained = (by_own >= EACH) & (by_second >= EACH) & (by_own + by_second >= BOTH)
    pairs = {(mask.region, mask.own, mask.other) for mask in named}
    shared = []
    views = regions.view_index.numpy()
    for view in np.unique(views[is_explained]).tolist():
        painted = paint_view(surfaces, cameras, view)
        for region in np.flatnonzero(is_explained & (views == view)).tolist():
            pair = int(own[region]), int(second[region])
            crop = regions.placed(region)
            mask = crop.pixels.numpy()
            seen = np.where(mask, crop.cut(painted), 0)
            if (region, *pair) in pairs or 2 * (seen == pair[1]).sum() >= (painted == pair[1]).sum():
                to_first, to_second = (distance_transform_edt(seen != instance) for instance in pair)
                part = torch.from_numpy(mask & (to_second < to_first))
                shared.append(MergedMask(region=region, own=pair[0], other=pair[1], part=part))
    return shared
