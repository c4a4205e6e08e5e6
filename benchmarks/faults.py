"""The faults of an instance segmenter, put into true masks: missed, merged, split, eroded and dilated instances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.uint16]
Mask = NDArray[np.bool_]

MIN_LEFT = 0.5  # share of its pixels that a mask keeps after erosion: segmenters do not wipe thin blades out


@dataclass(frozen=True)
class Faults:
    """How often a segmenter errs, each independently and in this order.

    Attributes:
        missed: share of the masks that are left out.
        merged: share of the pairs of touching masks that become one.
        split: share of the masks that are cut in two, across their long axis.
        blur_px: every mask is eroded or dilated by 1 to this many pixels; 0 leaves the outlines alone.
        min_pixels: masks that end up smaller are left out.
    """

    missed: float = 0.10
    merged: float = 0.05
    split: float = 0.05
    blur_px: int = 3
    min_pixels: int = 30


def degrade_labels(labels: Labels, faults: Faults, *, seed: int) -> Labels:
    """The masks (H, W) of a faulty segmenter, from the true masks (H, W) of one view, 0 = none. Their numbers, from 1,
    have nothing to do with those of `labels`. Where dilated masks overlap, the smaller one is on top."""
    rng = np.random.default_rng(seed)
    numbers = [n for n in np.unique(labels).tolist() if n and rng.random() >= faults.missed]
    masks = [labels == number for number in numbers]
    masks = merge_touching(masks, touching_pairs(labels, numbers), share=faults.merged, rng=rng)
    masks = [part for mask in masks for part in (cut(mask, rng) if rng.random() < faults.split else [mask])]
    masks = [blur(mask, faults.blur_px, rng) for mask in masks]
    degraded = np.zeros(labels.shape, np.uint16)
    for rank, mask in enumerate(sorted(masks, key=lambda mask: -int(mask.sum()))):
        degraded[mask] = rank + 1
    sizes = np.bincount(degraded.ravel())
    return np.where(sizes[degraded] >= faults.min_pixels, degraded, 0).astype(np.uint16)


def touching_pairs(labels: Labels, numbers: list[int]) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of indices into `numbers` whose masks have neighbouring pixels (of four neighbours)."""
    index_of = np.full(int(labels.max(initial=0)) + 1, -1)
    index_of[numbers] = np.arange(len(numbers))
    dense = index_of[labels]
    sides = [(dense[1:], dense[:-1]), (dense[:, 1:], dense[:, :-1])]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in sides])
    ends = np.unique(np.sort(ends[(ends[:, 0] != ends[:, 1]) & (ends.min(1) >= 0)], 1), axis=0)
    return [(a, b) for a, b in ends.tolist()]


def merge_touching(
    masks: list[Mask], pairs: list[tuple[int, int]], *, share: float, rng: np.random.Generator
) -> list[Mask]:
    """The masks with a random `share` of the pairs united; each mask takes part in one union at most."""
    merged = list(masks)
    is_free = np.ones(len(masks), bool)
    absorbed = set()
    for a, b in pairs:
        if rng.random() < share and is_free[a] and is_free[b]:
            merged[a] = masks[a] | masks[b]
            is_free[[a, b]] = False
            absorbed.add(b)
    return [mask for index, mask in enumerate(merged) if index not in absorbed]


def cut(mask: Mask, rng: np.random.Generator) -> list[Mask]:
    """Two parts of 25 to 75 % of a mask, cut by a line across its long axis."""
    rows, columns = np.nonzero(mask)
    points = np.stack([columns, rows], 1) - [columns.mean(), rows.mean()]
    axis = np.linalg.eigh(points.T @ points)[1][:, 1]
    along = points @ axis
    is_first = along < np.quantile(along, rng.uniform(0.25, 0.75))
    parts = [np.zeros_like(mask), np.zeros_like(mask)]
    parts[0][rows[is_first], columns[is_first]] = True
    parts[1][rows[~is_first], columns[~is_first]] = True
    return [part for part in parts if part.any()]


def blur(mask: Mask, most_px: int, rng: np.random.Generator) -> Mask:
    """The mask eroded or dilated by 1 to `most_px` pixels; erosion stops before it removes over half of the pixels."""
    if most_px == 0:
        return mask
    radius = int(rng.integers(1, most_px + 1))
    if rng.random() < 0.5:
        return cv2.dilate(mask.astype(np.uint8), disc(radius)).astype(bool)
    while radius:
        eroded = cv2.erode(mask.astype(np.uint8), disc(radius)).astype(bool)
        if eroded.sum() >= MIN_LEFT * mask.sum():
            return eroded
        radius -= 1
    return mask


def disc(radius: int) -> NDArray[np.uint8]:
    """(2 radius + 1, 2 radius + 1) structuring element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.uint8)
