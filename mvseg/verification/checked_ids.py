"""Surfaces check the ids: masks that show another instance's surface get its id. Not in the paper.

Rays and epipolar lines know nothing of shape. A surface that is fitted to an instance's masks in all views says what
each view must show of it. So it recognises its masks where they were matched to another instance (`shown_leaves.py`).
Where two surfaces explain one mask in disjoint parts, it shows two leaves (`find_shared`).
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.special import expit

from mvseg.masks import SURE, Masks, MergedMask
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.scene import Cameras
from mvseg.verification.evidence import Bools, Ints, paint_view, see
from mvseg.verification.numbers import AGAIN, PARTS
from mvseg.verification.shown_leaves import MaskQuestion, ask, settle_masks


def check_ids(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
    cache: SurfaceCache | None = None,
) -> Masks:
    """Move masks to the instances whose surfaces they show.

    These may be instances that are found among the masks that do not show their own. No mask loses its id without
    getting another. An instance may have several masks in a view afterwards: they show it together. With fewer than
    `AGAIN.least_views` views, masks that are surely matched stay. Last, the masks that show two surfaces are marked as
    merged (`find_shared`).

    Args:
        masks: D masks; those that are merged and move are forgotten to be so, unless they show two surfaces. Those that
            the user corrected or linked keep their ids.
        surfaces: {instance id: surface} fitted to them, of every instance that has one.
        config: that the masks were matched with.

    Returns:
        The same masks; those that moved have q as their match score. Instances that lost all their masks leave gaps
        between the ids; new ones have the highest.
    """
    on_cpu, cameras = masks.to("cpu"), cameras.to("cpu")
    is_held: Bools = (on_cpu.is_corrected | on_cpu.is_linked).numpy()
    if masks.regions.num_views < AGAIN.least_views:
        is_held = is_held | (on_cpu.match_scores >= SURE).numpy()
    question = ask(on_cpu, surfaces, cameras=cameras, config=config, is_held=is_held, cache=cache)
    leaf, odds = settle_masks(question)
    names = on_cpu.instance_ids[on_cpu.instance_ids > 0].unique().numpy()
    num_new = len(question.candidates) - len(names)
    names = np.concatenate((names, on_cpu.num_instances + 1 + np.arange(num_new), [-1]))
    ids = names[leaf]
    is_moved = ids != on_cpu.instance_ids.numpy()
    merged = {each.region: each for each in on_cpu.merged if not is_moved[each.region] and (ids == each.other).any()}
    pairs = {(each.region, each.own, each.other) for each in merged.values()}
    merged |= {each.region: each for each in find_shared(question, leaf, names, cameras=cameras, pairs=pairs)}
    scores = torch.from_numpy(np.where(is_moved, expit(odds), on_cpu.match_scores.double().numpy())).float()
    checked = replace(on_cpu, instance_ids=torch.from_numpy(ids), match_scores=scores).with_merged(merged.values())
    return replace(checked.to(masks.view_index.device), regions=masks.regions)


def find_shared(
    question: MaskQuestion, leaf: Ints, names: Ints, *, cameras: Cameras, pairs: Set[tuple[int, int, int]] = frozenset()
) -> list[MergedMask]:
    """Masks that two surfaces explain in disjoint parts: their own, and of all others the one that explains most.

    Half of the image of the second one must lie in the mask, or the matcher must have named the two: a
    mask that is drawn too large, or a surface that is drawn over another by mistake, shows a strip of it only. The
    second part is what is nearer to what is seen of the second surface than to what is seen of the first.

    Args:
        question: of D masks and K candidates.
        leaf: (D,) the candidate that each mask shows; -1 for none.
        names: (K + 1,) ids of the candidates.
        pairs: (mask, own id, other id) that the matcher named.
    """
    regions, candidates, every = question.masks.regions, question.candidates, np.arange(len(leaf))
    is_there = np.isin(np.arange(len(candidates)), leaf) & question.is_known & candidates.is_credible
    inside = np.where(is_there, see(question.drawn, len(leaf), is_there).inside, 0.0)
    inside = np.column_stack((inside, np.zeros(len(leaf))))  # of no candidate
    by_own = inside[every, leaf]
    inside[every, leaf] = 0
    second, by_second = inside.argmax(1), inside.max(1)
    is_explained = (by_own >= PARTS.each) & (by_second >= PARTS.each) & (by_own + by_second >= PARTS.both)
    surfaces = {int(names[n]): each for n, each in enumerate(candidates.surfaces) if is_there[n] and each is not None}
    views, shared = regions.view_index.numpy(), []
    for view in np.unique(views[is_explained]).tolist():
        painted = paint_view(surfaces, cameras, view)
        for region in np.flatnonzero(is_explained & (views == view)).tolist():
            pair = int(names[leaf[region]]), int(names[second[region]])
            crop = regions.placed(region)
            mask = crop.pixels.numpy()
            seen = np.where(mask, crop.cut(painted), 0)
            if (region, *pair) in pairs or 2 * (seen == pair[1]).sum() >= (painted == pair[1]).sum():
                to_first, to_second = (distance_transform_edt(seen != instance) for instance in pair)
                part = torch.from_numpy(mask & (to_second < to_first))
                shared.append(MergedMask(region=region, own=pair[0], other=pair[1], part=part))
    return shared
