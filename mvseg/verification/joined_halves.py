"""A leaf in two halves, each of which is a leaf to all views: one more candidate, of both. Not in the paper.

A detector that finds a large leaf in pieces cuts it where no edge is. So the masks of halves overlap, while leaves end
where others begin; their surfaces touch, one surface shows both as well, and the photo has no more of an edge between
them than within them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from mvseg.arrays import Bools, Floats, Pixels
from mvseg.crop import Crop
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks, replace_crops
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.candidates import Fit
from mvseg.verification.numbers import CHOICE, HALVES, SNAP

Pair = tuple[int, int]
Both = dict[int, tuple[Crop, Crop]]  # {view: masks of two leaves}


def join_halves(masks: Masks, photos: ReadPhoto, fit: Fit) -> Masks | None:
    """Join the halves of leaves.

    Args:
        masks: D masks of L leaves, at most one of a leaf in a view, on the CPU; of two leaves, the likelier one first.
        fit: {instance id: surface} to instances of masks.

    Returns:
        Masks of the joined leaves, with ids of their own: in a view that shows both halves one mask, the union, whose
        `proposal` is -1; in the others the mask that there is. None where no two leaves are halves of one.
    """
    pairs, joined = _overlapping(masks), dict[Pair, Masks]()
    named = torch.tensor([leaf for pair in pairs for leaf in pair], dtype=torch.int64)
    surfaces = fit(masks.select(torch.isin(masks.instance_ids, named)))
    for pair, both in pairs.items():
        halves = [surfaces[leaf] for leaf in pair if leaf in surfaces and surfaces[leaf].exists]
        if {*pair} & {leaf for each in joined for leaf in each} or len(halves) < 2 or not touch(*halves):
            continue
        if np.median([share_edge(*each, photos(view)) for view, each in both.items()]) <= HALVES.edge:
            leaf = _join(masks, pair, both)
            if shows_both(fit(leaf).get(1), halves):
                joined[pair] = leaf
    return Masks.concatenate([*joined.values()]) if joined else None


def _overlapping(masks: Masks) -> dict[Pair, Both]:
    """Pairs of leaves that overlap by `HALVES.overlap` or more, most first; their masks in views that show both."""
    ids, views, areas = masks.instance_ids.tolist(), masks.view_index.tolist(), masks.regions.areas.tolist()
    placed = {(leaf, view): masks.regions.placed(row) for row, (leaf, view) in enumerate(zip(ids, views, strict=True))}
    totals, pairs = defaultdict[Pair, float](float), list[tuple[float, Pair, Both]]()
    for one, other, shared in masks.regions.overlaps():
        totals[min(ids[one], ids[other]), max(ids[one], ids[other])] += shared / min(areas[one], areas[other])
    for (low, high), total in totals.items():
        shown = [view for view in sorted({*views}) if {(low, view), (high, view)} <= placed.keys()]
        if low > 0 and len(shown) >= CHOICE.least_views and total >= HALVES.overlap * len(shown):
            both = {view: (placed[low, view], placed[high, view]) for view in shown}
            pairs.append((-round(total / len(shown), CHOICE.digits), (low, high), both))
    return {pair: both for _, pair, both in sorted(pairs, key=lambda each: each[:2])}


def touch(one: LeafSurface, other: LeafSurface) -> bool:
    """Whether the surfaces of two halves touch."""
    return one.distance_to(other) <= HALVES.touches * one.length


def shows_both(surface: LeafSurface | None, halves: Iterable[LeafSurface], *, fits: float = HALVES.fits) -> bool:
    """Whether one surface shows the masks of both halves by the IoU of the worse one, times `fits`."""
    worst = min(float(each.iou.nanmedian()) for each in halves)
    return surface is not None and surface.exists and float(surface.iou.nanmedian()) >= fits * worst


def _join(masks: Masks, pair: Pair, both: Both) -> Masks:
    """The masks of both as those of one leaf, with an id of 1, and the scores of the likelier half where both are."""
    is_both = torch.isin(masks.view_index, torch.tensor([*both]))
    rows = (masks.instance_ids == pair[0]) | ((masks.instance_ids == pair[1]) & ~is_both)
    leaf, proposal = masks.select(rows), masks.proposal.where(~is_both, -1)[rows]
    views, placed = leaf.view_index.tolist(), leaf.regions.placed
    crops = [both[view][0].union(both[view][1]) if view in both else placed(row) for row, view in enumerate(views)]
    return replace(replace_crops(leaf, crops), instance_ids=torch.ones_like(proposal), proposal=proposal)


def share_edge(one: Crop, other: Crop, photo: Pixels) -> float:
    """Edge between two masks, as a share of the edges within them: how fast colours (CIELAB) change, along the middle
    between both, and anywhere deep in one of them; the worst pixel within a band counts (`SNAP.band`), on average.

    Args:
        photo: (H, W, 3) uint8 RGB of the view.

    Returns:
        Infinity where they do not touch, or both are too thin to tell.
    """
    side = math.sqrt(min(one.area, other.area))
    scale, room = min(1.0, SNAP.most_px / side), math.ceil(SNAP.around * SNAP.band * side)
    x1, y1, x2, y2 = one.union(other).box
    box = max(0, x1 - room), max(0, y1 - room), min(photo.shape[1], x2 + room), min(photo.shape[0], y2 + room)
    size = round((box[2] - box[0]) * scale), round((box[3] - box[1]) * scale)
    shown = [each.within(box).pixels.numpy().astype(np.uint8) for each in (one, other)]
    first, second = (cv2.resize(each, size, interpolation=cv2.INTER_NEAREST).astype(bool) for each in shown)
    band = max(1, round(SNAP.band * side * scale))
    reach = SNAP.around * band
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    union = cv2.morphologyEx((first | second).astype(np.uint8), cv2.MORPH_CLOSE, disk) > 0
    around = cv2.resize(photo[box[1] : box[3], box[0] : box[2]], size, interpolation=cv2.INTER_AREA)
    change = maximum_filter(np.where(_depth(union) > band, _color_change(around), 0), 2 * band + 1)
    way, way_other = (_depth(~each) - _depth(each) for each in (first, second))
    is_middle = (abs(way - way_other) <= band) & (np.maximum(way, way_other) <= reach) & (_depth(union) > band + 1)
    is_deep = np.maximum(_depth(first & ~second), _depth(second & ~first)) > band + 1
    is_told = is_middle.any() and is_deep.any()
    return float(change[is_middle].mean() / max(change[is_deep].mean(), 1e-9)) if is_told else math.inf


def _depth(is_inside: Bools) -> Floats:
    """(H, W) distance from the nearest pixel outside, in pixels."""
    return np.asarray(cv2.distanceTransform(is_inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), float)


def _color_change(photo: NDArray[Any]) -> Floats:
    """(H, W) gradient of the colours of a photo (H, W, 3), per pixel."""
    lab = cv2.GaussianBlur(cv2.cvtColor(photo, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1.0)
    slopes = [cv2.Sobel(lab, cv2.CV_32F, *axes, ksize=3, scale=1 / 8) for axes in ((1, 0), (0, 1))]
    return np.asarray(np.linalg.norm(np.concatenate(slopes, 2), axis=2), float)
