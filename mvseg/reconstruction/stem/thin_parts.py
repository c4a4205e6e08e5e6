"""Thin parts of a plant in photos, and the cells of space that the views agree to show them in.

Stems and petioles are green or brown, dark or bright: their colour surely differs only from its surroundings on both
sides. Leaves hide: nothing is known within their masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter, uniform_filter

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import THIN


@dataclass(frozen=True, eq=False)
class ThinView:
    """One view, made smaller.

    Attributes:
        share: (h, w) float32 in [0, 1], how surely a pixel differs from its surroundings; 0 in leaves.
        is_hidden: (h, w) bool, in or next to a leaf.
        px_from_world: (3, 4), to its pixels.
    """

    share: NDArray[np.float32]
    is_hidden: NDArray[np.bool_]
    px_from_world: Floats


def see_thin(photo: NDArray[np.uint8], is_leaf: NDArray[np.bool_], px_from_world: Floats, points: Floats) -> ThinView:
    """Find thin parts in one photo (H, W, 3) RGB, around the image of `points` (P, 3) of the plant. `is_leaf` (H, W)
    unites the masks of all leaves; `px_from_world` is (3, 4)."""
    cam = points @ px_from_world[:, :3].T + px_from_world[:, 3]
    px = cam[:, :2] / np.maximum(cam[:, 2:], 1e-9)
    size = np.array(is_leaf.shape[::-1])
    margin = THIN.margin * np.ptp(px, axis=0)
    low = np.clip(np.floor(px.min(0) - margin), 0, size - 1).astype(int)
    high = np.maximum(np.clip(np.ceil(px.max(0) + margin), 0, size).astype(int), low + 1)
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    scale = max(1.0, float((high - low).max()) / THIN.longest_px)
    width, height = (max(1, round(side / scale)) for side in (high - low).tolist())
    small = cv2.resize(np.ascontiguousarray(photo[part]), (width, height), interpolation=cv2.INTER_AREA)
    hidden = cv2.resize(is_leaf[part].astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0
    hidden = cv2.dilate(hidden.astype(np.uint8), np.ones((2 * THIN.beside_px + 1,) * 2, np.uint8)) > 0
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    if hidden.any() and not hidden.all():  # leaves take the colour next to them
        lab = lab[tuple(distance_transform_edt(hidden, return_distances=False, return_indices=True))]
    around = cv2.medianBlur(lab, 2 * THIN.around_px + 1)
    apart = np.sqrt(((lab.astype(np.float32) - around) ** 2).sum(2))
    noise = float(np.median(apart[~hidden])) if not hidden.all() else 0.0
    share = np.clip((apart - THIN.quiet * noise) / (THIN.surely * noise + THIN.least_apart), 0, 1)
    matrix = px_from_world.copy()
    matrix[:2] -= low[:, None] * matrix[2]
    matrix[:2] *= np.array([[width / (high[0] - low[0])], [height / (high[1] - low[1])]])
    return ThinView(np.where(hidden, 0, share).astype(np.float32), hidden, matrix)


@dataclass(frozen=True, eq=False)
class ThinCells:
    """Cells of space that show something thin: their middles (P, 3), the mean (P,) in [0, 1] of `ThinView.share` over
    the views that look there, and the side of a cell."""

    points: Floats
    share: Floats
    size: float


def find_cells(views: Sequence[ThinView], points: Floats, axes: Floats) -> ThinCells:
    """Cells around a plant of points (P, 3) that most views which see them show as thin; small ones only where larger
    ones do. Cells lie along `axes` (3, 3), in rows, of the plant itself."""
    own = points @ axes.T
    low, high = own.min(0), own.max(0)
    beyond = THIN.beyond * float((high - low).max())
    low, high = low - beyond, high + beyond
    size = float((high - low).max()) / THIN.coarse_cells
    counts = np.ceil((high - low) / size).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    for level in range(THIN.levels):
        if level:
            within = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), -1).reshape(-1, 3)
            cells, size = (2 * cells[:, None] + within).reshape(-1, 3), size / 2
        middles = (low + size * (cells + 0.5)) @ axes
        share = share_of_views(views, middles, size)
        keep = share > THIN.least_share
        cells, middles, share = cells[keep], middles[keep], share[keep]
    if len(cells):  # soil and what stands around are thick
        filled = np.zeros(cells.max(0) + 1, np.float32)
        filled[tuple(cells.T)] = 1
        keep = uniform_filter(filled, THIN.around_cells, mode="constant")[tuple(cells.T)] < THIN.most_filled
        cells, middles, share = cells[keep], middles[keep], share[keep]
    if len(share) > THIN.most_cells:
        keep = share >= np.partition(share, -THIN.most_cells)[-THIN.most_cells]
        middles, share = middles[keep], share[keep]
    return ThinCells(middles, share, size)


def share_of_views(views: Sequence[ThinView], points: Floats, size: float) -> Floats:
    """(P,) mean over the views that see cells of this size about points (P, 3) of the surest pixel in each; NaN
    where too few views see them."""
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for view in views if len(points) else ():
        cam = points @ view.px_from_world[:, :3].T + view.px_from_world[:, 3]
        depth = np.maximum(cam[:, 2], 1e-9)
        x, y = (cam[:, axis] / depth for axis in (0, 1))
        rows, columns = view.share.shape
        reach = size * float(np.linalg.norm(view.px_from_world[0, :3])) / float(np.median(depth))
        pooled = maximum_filter(view.share, max(1, 2 * round(reach / 2) + 1))
        inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows) & (cam[:, 2] > 0)
        place = np.where(inside, y, 0).astype(int) * columns + np.where(inside, x, 0).astype(int)
        sees = inside & ~view.is_hidden.ravel()[place]
        total += np.where(sees, pooled.ravel()[place], 0)
        count += sees
    enough = max(THIN.least_views, THIN.view_share * len(views))
    return np.where(count >= enough, total / np.maximum(count, 1), np.nan)
