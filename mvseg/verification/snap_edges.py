"""Edges of masks follow those of colour. Not in the paper.

A mask head answers on a small grid, and surfaces are smooth: both draw outlines that lie beside the leaf's. So within a
narrow band along a mask's outline the photo decides, by GrabCut (Rother, Kolmogorov, Blake 2004). Where other views
show that a mask lacks a part of its leaf (`missing_parts.py`), the photo decides about that part, too.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.arrays import Bools, Pixels
from mvseg.crop import Crop
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks, Origin, replace_crops
from mvseg.verification.numbers import SNAP

# confirmed masks are snapped too: the user saw them with the snapped edge
FOUND = torch.tensor([Origin.DETECTED, Origin.CONFIRMED])


def snap_masks(
    masks: Masks,
    photos: ReadPhoto,
    *,
    missing: Sequence[Crop | None] = (),
    cache: dict[str, Any] | None = None,
) -> Masks:
    """Move the edges of the masks that a detector found to those of colour, see `snap`; the others stay as they are.

    None grows into another mask of its view, nor do two grow into the same pixel: the first row has it.

    Args:
        missing: D, see `find_missing_parts`; (): none lacks any.
        cache: {digest of the arguments of `snap`: its answer}; learns new ones.
    """
    cache = {} if cache is None else cache
    regions = masks.regions.to("cpu")
    moves = torch.isin(masks.origin, FOUND.to(masks.origin)).cpu()
    crops = [regions.placed(row) for row in range(len(regions))]
    for view in regions.view_index[moves].unique().tolist():
        photo = photos(view)
        rows = (regions.view_index == view).nonzero()[:, 0].tolist()
        taken = np.zeros(photo.shape[:2], bool)
        for row in rows:
            covered = crops[row].cut(taken)
            covered |= crops[row].pixels.numpy()
        for row in (row for row in rows if moves[row]):
            part = missing[row] if missing else None
            whole = crops[row] if part is None else crops[row].union(part)
            room = math.ceil(SNAP.around * SNAP.band * math.sqrt(whole.area)) + 1
            x1, y1 = (max(0, low - room) for low in whole.box[:2])
            x2, y2 = (min(size, high + room) for size, high in zip(photo.shape[1::-1], whole.box[2:], strict=True))
            around = whole.within((x1, y1, x2, y2))
            mask, covered = crops[row].within(around.box).pixels.numpy(), around.cut(taken)
            others = covered & ~mask
            likely = mask if part is None else around.pixels.numpy() & ~others
            asked = mask, around.cut(photo), others, likely
            digest = hashlib.sha256(b"".join(f"{each.shape}".encode() + each.tobytes() for each in asked)).hexdigest()
            if digest not in cache:
                cache[digest] = torch.from_numpy(snap(mask, asked[1], others=others, likely=likely))
            snapped = cache[digest].numpy()
            covered |= snapped
            crops[row] = Crop.of(snapped, (x1, y1))
    return replace_crops(masks, crops)


def snap(mask: Bools, photo: Pixels, *, others: Bools, likely: Bools | None = None) -> Bools:
    """The mask whose edge lies where colours change, within `SNAP.band` of where it was.

    Args:
        mask: (H, W) bool, with room for the background around it.
        photo: (H, W, 3) uint8 RGB.
        others: (H, W) bool, disjoint from the mask: what other masks show.
        likely: (H, W) bool, the mask and the part of its leaf that it lacks, disjoint from `others`; None: the mask.
            The edge lies within a band around this one, and none of the part is surely leaf.

    Returns:
        (H, W) bool. The mask as it is, where too little of it lies deep inside, or nothing is around it.
    """
    height, width = mask.shape
    whole = mask if likely is None else likely
    scale = min(1.0, SNAP.most_px / max(math.sqrt(whole.sum()), 1.0))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    inner, inside, beside = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5 for each in (mask, whole, others)
    )
    radius = max(1, round(SNAP.band * math.sqrt(inside.sum())))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    deep = inner & (cv2.erode(inside.astype(np.uint8), disk, borderValue=1) > 0)
    far = (cv2.dilate(inside.astype(np.uint8), disk) == 0) | (beside & ~inside)
    if min(deep.sum(), far.sum()) < SNAP.least_pixels:
        return mask
    state = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    state[deep], state[far] = cv2.GC_FGD, cv2.GC_BGD
    leaf = cut_by_color(small, state, rounds=1).astype(np.float32)
    return np.asarray(cv2.resize(leaf, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5) & ~others


def cut_by_color(photo: NDArray[Any], state: Pixels, *, rounds: int) -> Bools:
    """(H, W) bool, the leaf by GrabCut in a photo (H, W, 3), from the `state` (H, W) of each pixel, which changes."""
    cv2.setRNGSeed(0)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    how = background, foreground, rounds, cv2.GC_INIT_WITH_MASK
    cv2.grabCut(photo, state, None, *how)  # type: ignore[call-overload]
    return (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
