"""Surfaces check the ids: masks that show another instance's surface get its id. Not in the paper.

Rays and epipolar lines know nothing of shape. A surface that is fitted to an instance's masks in all views says what
each view must show of it. So it recognises the pieces of its leaf where leaves that cross it made several masks of one
(`move_pieces`), and where two instances are halves of one leaf, one surface explains the masks of both
(`join_halves.py`). It recognises its masks where they were matched to another instance (`shown_leaves.py`). Where two
surfaces explain one mask in disjoint parts, it shows two leaves (`find_shared`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.special import expit

from mvseg.masks import SURE, Masks, MergedMask
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.evidence import Bools, Floats, Ints, Shown, paint_view
from mvseg.verification.join_halves import join_halves, seen_rarely
from mvseg.verification.numbers import AGAIN, PARTS
from mvseg.verification.shown_leaves import ask, settle

Surfaces = Mapping[int, LeafSurface]


def check_ids(
    masks: Masks,
    surfaces: Surfaces,
    *,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
) -> Masks:
    """Move masks to the instances whose surfaces they show.

    First the pieces (`move_pieces`) and the halves of leaves (`join_halves`), then all others that show another surface
    than their own, which may be that of an instance that is found among them (`ask_surfaces`). No mask loses its id
    without getting another. An instance may have several masks in a view afterwards: they show it together. With fewer
    than `AGAIN.least_views` views, masks that are surely matched stay. Last, the masks that show two surfaces are
    marked as merged (`find_shared`).

    Args:
        masks: D masks; those that are merged and move are forgotten to be so, unless they show two surfaces. Those that
            a person corrected or linked keep their ids, and their instances are joined with none.
        surfaces: {instance id: surface} fitted to them, of every instance that has one.
        cameras: V cameras.
        config: that the masks were matched with.

    Returns:
        The same masks. Pieces and halves that moved have the mean match score of those that had the id before, others
        q. Instances that lost all their masks leave gaps between the ids; new ones have the highest.
    """
    on_cpu, cameras = masks.to("cpu"), cameras.to("cpu")
    is_held: Bools = (on_cpu.is_corrected | on_cpu.is_linked).numpy()
    if masks.regions.num_views < AGAIN.least_views:
        is_held = is_held | (on_cpu.match_scores >= SURE).numpy()
    shown = Shown.of(on_cpu.regions, surfaces, cameras)
    pieced = move_pieces(on_cpu, shown, is_held=is_held)
    joined, known = join_parts(pieced, surfaces, cameras=cameras, is_held=is_held)
    is_held |= (pieced.instance_ids != on_cpu.instance_ids).numpy()
    checked = ask_surfaces(joined, known, cameras=cameras, config=config, is_held=is_held)
    merged = {each.region: each for each in checked.merged}
    merged |= {each.region: each for each in find_shared(checked, surfaces, shown=shown, cameras=cameras)}
    return replace(checked.with_merged(merged.values()).to(masks.view_index.device), regions=masks.regions)


def ask_surfaces(masks: Masks, surfaces: Surfaces, *, cameras: Cameras, config: MatchConfig, is_held: Bools) -> Masks:
    """Each mask gets the id of the instance that it shows, see `shown_leaves.py`; with another id it has q as its match
    score. Those that are held (D,) stay."""
    question = ask(masks, surfaces, cameras=cameras, config=config, is_held=is_held)
    leaf, odds = settle(question)
    names = masks.instance_ids[masks.instance_ids > 0].unique().numpy()
    num_new = len(question.candidates) - len(names)
    names = np.concatenate((names, masks.num_instances + 1 + np.arange(num_new), [-1]))
    return _with_ids(masks, names[leaf], expit(odds))


def join_parts(masks: Masks, surfaces: Surfaces, *, cameras: Cameras, is_held: Bools) -> tuple[Masks, Surfaces]:
    """The masks once halves are joined, see `join_halves`, and the surfaces of all instances."""
    ids = masks.instance_ids.numpy()
    free = {instance: each for instance, each in surfaces.items() if not (is_held & (ids == instance)).any()}
    joined = join_halves(masks.regions, ids, free, cameras=cameras)
    if (joined == ids).all():
        return masks, surfaces
    alone = torch.from_numpy(np.where(np.isin(joined, joined[joined != ids]), joined, -1))
    fitted = fit_surfaces(masks.regions, alone, cameras)
    return _with_ids(masks, joined, _mean_scores(masks, joined)), {**surfaces, **fitted}


def _mean_scores(masks: Masks, ids: Ints) -> Floats:
    """(D,) the mean match score of those masks that had each of these ids (D,)."""
    old, scores = masks.instance_ids.numpy(), masks.match_scores.double().numpy()
    means: Floats = np.array([scores[old == instance].mean() for instance in ids.tolist()])
    return means


def _with_ids(masks: Masks, ids: Ints, scores: Floats) -> Masks:
    """The masks with these ids (D,); those that moved have these scores (D,), and are forgotten to be merged."""
    is_moved = torch.from_numpy(ids != masks.instance_ids.numpy())
    merged = [each for each in masks.merged if not is_moved[each.region] and (ids == each.other).any()]
    scored = torch.where(is_moved, torch.from_numpy(scores).float(), masks.match_scores)
    return replace(masks, instance_ids=torch.from_numpy(ids), match_scores=scored).with_merged(merged)


def move_pieces(masks: Masks, shown: Shown, *, is_held: Bools) -> Masks:
    """Masks of instances that are made of pieces of leaves get the ids of these leaves.

    Where leaves cross, each piece may have a mask of its own, and pieces found in several views form instances of their
    own, with surfaces that lie in those of the leaves. So the surfaces of instances that few views show are left out,
    and those of all others drawn. An instance of few views most of whose masks lie in one of these, which need not
    be the same for all, is made of pieces: those masks join the leaves that they lie in, with the mean match score of
    the leaf's own.

    Args:
        masks: D masks on the CPU.
        shown: what the views show of them and of the surfaces.
        is_held: (D,) those that keep their ids.
    """
    ids = masks.instance_ids.numpy()
    few = seen_rarely(masks.regions, ids)
    inside = shown.compare(set(shown.instances.tolist()) - set(few)).inside
    is_inside, revised = inside.max(1) >= PARTS.piece_inside, ids.copy()
    for instance in few:
        own = ids == instance
        if 2 * (own & is_inside).sum() > own.sum():
            revised[own & is_inside & ~is_held] = inside[own & is_inside & ~is_held].argmax(1)
    return _with_ids(masks, revised, _mean_scores(masks, revised))


def find_shared(masks: Masks, surfaces: Surfaces, *, shown: Shown, cameras: Cameras) -> list[MergedMask]:
    """Masks that two surfaces explain in disjoint parts: their own, and of all others the one that explains most.

    Half of what the view shows of the second one must lie in the mask, or the matcher must have named the two: a
    mask that is drawn too large, or a surface that is drawn over another by mistake, shows a strip of it only. The
    second part is what is nearer to what is seen of the second surface than to what is seen of the first. For the other
    arguments see `move_pieces`.
    """
    regions, ids = masks.regions, masks.instance_ids.numpy()
    surfaces = {instance: surface for instance, surface in surfaces.items() if (ids == instance).any()}
    inside, every = shown.compare(surfaces).inside, np.arange(len(ids))
    own = np.where(np.isin(ids, shown.instances), ids, 0)  # others have no surface, and no column
    by_own = inside[every, own]
    inside[every, own] = 0
    second, by_second = inside.argmax(1), inside.max(1)
    is_explained = (by_own >= PARTS.each) & (by_second >= PARTS.each) & (by_own + by_second >= PARTS.both)
    pairs = {(mask.region, mask.own, mask.other) for mask in masks.merged}
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
