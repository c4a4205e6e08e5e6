"""Masks that lie outside their own surface are matched once more, all others held. Not in the paper.

Where leaves are dense, the masks of one leaf may be scattered: each went to a leaf that has no mask in its view, and
along the rays it fits there. But the surface of that leaf lies elsewhere in its photo. Freed all at once, such masks
find each other, or the leaf that they show.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from mvseg.errors import InputWarning
from mvseg.masks import VERY_SURE, Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links
from mvseg.matching.match import match_masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.evidence import FITS, Shown

LEAST_INSIDE = 0.4  # a mask shows something else if less than this fraction of it lies within its surface's outline


def rematch_misfits(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface],
    *,
    shown: Shown,
    cameras: Cameras,
    free: Tensor,
    config: MatchConfig = MatchConfig(),
) -> Masks:
    """Take masks that do not show their own surface out of their instances, and match them and those without an id.

    All other masks stay together as they are, instances stay apart, and no mask goes back to the instance that it was
    taken from (`Links`): it joins another one, or several of them form a new one. What finds nothing keeps its id.

    Args:
        masks: D masks, matched by the method "nview": with any other, they stay as they are.
        surfaces: {instance id: surface} of the instances whose masks may be taken, fitted to just these masks.
        shown: what the views show of the masks and of all surfaces.
        cameras: V cameras.
        free: (D,) bool; the others keep their ids.
        config: that the masks were matched with.

    Returns:
        The same masks. Those with another id have the score of the second matching, and are forgotten to be merged; new
        instances have the highest ids.
    """
    is_misfit = find_misfits(masks, surfaces, shown) & free.to(masks.view_index.device)
    if config.resolved_method != "nview" or not is_misfit.any():
        return masks
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # the first matching has said it
        matching = match_masks(masks, cameras, config, links=_links(masks.instance_ids.cpu(), is_misfit.cpu()))
    if matching.report.method != "nview":
        return masks
    return _with_found(masks, matching.masks, is_free=is_misfit | (masks.instance_ids < 0))


def find_misfits(masks: Masks, surfaces: Mapping[int, LeafSurface], shown: Shown) -> Tensor:
    """(D,) bool: masks that lie outside their own surface, that do not fit it either way, and that are not sure.

    For the arguments see `rematch_misfits`. Nothing hides anything here: a mask of a leaf that is half hidden lies
    within what can be seen of the leaf. The IoU is that of the fit (`LeafSurface.iou`), which knows of masks that are
    drawn too large or too small; 0 in views that the fit left out.
    """
    inside, is_misfit = shown.compare(surfaces, hide=False).inside, torch.zeros(len(masks), dtype=torch.bool)
    ids, views = masks.instance_ids.cpu(), masks.view_index.tolist()
    for instance, surface in surfaces.items():
        if not surface.exists:
            continue
        ious = dict(zip(surface.views.tolist(), surface.iou.nan_to_num(0).tolist(), strict=True))
        for row in ((ids == instance) & (masks.match_scores.cpu() < VERY_SURE)).nonzero()[:, 0].tolist():
            is_misfit[row] = bool(ious.get(views[row], 0.0) < FITS and inside[row, instance] < LEAST_INSIDE)
    return is_misfit.to(masks.view_index.device)


def _links(ids: Tensor, is_misfit: Tensor) -> Links:
    """What stays together and apart; `ids` and `is_misfit` (D,)."""
    must: list[tuple[int, int]] = []
    cannot: list[tuple[int, int]] = []
    firsts: list[int] = []
    for instance in ids[ids > 0].unique().tolist():
        first, *others = ((ids == instance) & ~is_misfit).nonzero()[:, 0].tolist() or [None]
        if first is None:
            continue
        must += [(first, other) for other in others]
        cannot += [(first, row) for row in ((ids == instance) & is_misfit).nonzero()[:, 0].tolist()]
        cannot += [(first, earlier) for earlier in firsts]
        firsts.append(first)
    return Links.of(must, cannot)


def _with_found(masks: Masks, found: Masks, *, is_free: Tensor) -> Masks:
    """The masks (D,), those that are free with the instances that were found: the ones of the others, or new ones."""
    ids, last = masks.instance_ids.clone(), masks.num_instances
    for number in found.instance_ids[is_free & (found.instance_ids > 0)].unique().tolist():
        together = found.instance_ids == number
        kept = masks.instance_ids[together & ~is_free]
        last += not len(kept)
        ids[together & is_free] = kept[0] if len(kept) else last
    is_moved = ids != masks.instance_ids
    merged = [each for each in masks.merged if not is_moved[each.region] and (ids == each.other).any()]
    scores = torch.where(is_moved, found.match_scores, masks.match_scores)
    return replace(masks, instance_ids=ids, match_scores=scores).with_merged(merged)
