"""What cameras see of a patch: its projection, the pixels that it covers, and which neighbours lie behind it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvseg.reconstruction.surface.leaf_patch import Floats
from mvseg.reconstruction.surface.mask_stack import BLUR_PX, MaskStack

SUPERSAMPLED = 3  # side of the small pixels that patches are drawn in
DRAWN_TOO_FAR = 0.48  # small pixels, measured
SUB_PIXEL_BITS = 4  # of OpenCV's polygons
LEAST_GROWTH_PX = 0.15  # offsets that are worth the time
NEAR_PX = 4  # around a mask, where it matters what lies in front


@dataclass(frozen=True, eq=False)
class Projection:
    """A patch grid in S views: px (S, rows, columns, 2) and depths (S, rows, columns)."""

    px: Floats
    depth: Floats


def project_points(px_from_world: Floats, points: Floats) -> Projection:
    """Project grid points (rows, columns, 3) by S matrices (S, 3, 4); depths are kept above zero."""
    flat = points.reshape(-1, 3)
    cam = flat @ px_from_world[:, :, :3].transpose(0, 2, 1) + px_from_world[:, None, :, 3]
    depth = np.maximum(cam[..., 2], 1e-9)
    shape = (len(px_from_world), *points.shape[:2])
    return Projection(px=(cam[..., :2] / depth[..., None]).reshape(*shape, 2), depth=depth.reshape(shape))


def cover_crop(masks: MaskStack, projection: Projection, index: int) -> NDArray[np.uint8]:
    """(rows, columns) 1 where the quads of the projected grid cover a crop; every second row will do."""
    shape = masks.shapes[index]
    local = (projection.px[index] - masks.corners[index] - 0.5) * (1 << SUB_PIXEL_BITS)
    limit = 1 << (SUB_PIXEL_BITS + 13)
    corners = np.clip(np.round(local), -limit, limit).astype(np.int32)
    pick = np.unique(np.r_[np.arange(0, len(corners), 2), len(corners) - 1])
    corners = corners[pick][:, ::2]
    canvas = np.zeros((int(shape[0]), int(shape[1])), np.uint8)
    for quad in grid_quads(corners):
        cv2.fillConvexPoly(canvas, quad, 1, shift=SUB_PIXEL_BITS)
    return canvas


def view_ious(masks: MaskStack, points: Floats, *, offsets: Floats | None = None) -> Floats:
    """(S,) IoU of grid points (rows, columns, 3) of a patch and the mask in each view, where nothing else hides it.

    With `offsets` (S,), pixels, the patch is drawn as much too large or small as the mask of each view is.
    """
    shares = draw_patch(masks, project_points(masks.px_from_world, points), offsets=offsets, blur_px=0.0)
    is_covered = (shares >= 0.5) & (masks.others == 0)
    ious = []
    for index in range(len(masks)):
        covered, inside = masks.crop(is_covered, index), masks.crop(masks.inside, index)
        ious.append((covered & inside).sum() / max(1, (covered | inside).sum()))
    return np.array(ious)


def draw_patch(
    masks: MaskStack, projection: Projection, *, offsets: Floats | None = None, blur_px: float = BLUR_PX
) -> NDArray[np.float32]:
    """(pixels,) the projected grid as a blurred mask, like `MaskStack.blurred`; sharp with a blur of 0.

    With `offsets` (S,), pixels, it is grown or shrunk as the mask of each view seems to be.
    """
    drawn = []
    for index in range(len(masks)):
        height, width = masks.shapes[index].tolist()
        canvas = _draw_small(grid_quads(projection.px[index]), (width, height), masks.corners[index])
        if offsets is not None and abs(offsets[index]) > LEAST_GROWTH_PX:
            canvas = grow(canvas, SUPERSAMPLED * float(offsets[index]))
        share = _shares(canvas, (width, height))
        drawn.append((cv2.GaussianBlur(share, (0, 0), blur_px) if blur_px else share).ravel())
    return np.concatenate(drawn)


def grow(canvas: NDArray[np.uint8], px: float) -> NDArray[np.uint8]:
    """Pixels (rows, columns) of 0 or 255, grown by `px` pixels, or shrunk where that is negative."""
    is_away = canvas == 0 if px > 0 else canvas > 0
    # Distances are to pixel centres: the border is half a pixel nearer.
    is_near = cv2.distanceTransform(is_away.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) < abs(px) + 0.5
    grown: NDArray[np.uint8] = np.where(is_near if px > 0 else is_away & ~is_near, np.uint8(255), np.uint8(0))
    return grown


def grid_quads(grid: Floats) -> Floats:
    """(quads, 4, n) corners in turn of the cells of a grid (rows, columns, n)."""
    quads = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], 2)
    return quads.reshape(-1, 4, grid.shape[-1])


def draw_polygons(polygons: Floats, size: tuple[int, int], corner: Floats) -> NDArray[np.float32]:
    """(height, width) share of each pixel that convex polygons (T, n, 2) cover.

    Drawn several times as large. OpenCV's polygons include their border: they are DRAWN_TOO_FAR small pixels too wide
    on every side.
    """
    return _shares(_draw_small(polygons, size, corner), size)


def _draw_small(polygons: Floats, size: tuple[int, int], corner: Floats) -> NDArray[np.uint8]:
    width, height = size
    scale = SUPERSAMPLED
    local = ((polygons - corner) * scale - 0.5) * (1 << SUB_PIXEL_BITS)
    local = np.clip(np.round(local), -(1 << 26), 1 << 26).astype(np.int32)
    canvas = np.zeros((height * scale, width * scale), np.uint8)
    for polygon in local:
        cv2.fillConvexPoly(canvas, polygon, 255, shift=SUB_PIXEL_BITS)
    return canvas


def _shares(canvas: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
    share: NDArray[np.float32] = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return share / np.float32(255)


def hiding_pixels(
    masks: MaskStack, points: Floats, others: dict[int, Floats], *, margin: float
) -> NDArray[np.int32]:
    """(pixels,) int32: which instance hides the leaf there, 0 for none, as the surfaces have it.

    A pixel that shows another instance hides nothing where that one's surface lies behind the leaf. And a surface in
    front of the leaf hides it, whether that instance has a mask there or not.

    Args:
        masks: of the leaf.
        points: (rows, columns, 3) grid points of its present patch.
        others: instance id -> grid points of its patch. Instances without a patch may hide anything.
        margin: world units by which another one must be farther away to lie behind, or nearer to lie in front.
    """
    hiding = masks.others.copy()
    projection = project_points(masks.px_from_world, points)
    seen = {other: project_points(masks.px_from_world, grid) for other, grid in others.items()}
    for index in range(len(masks)):
        crop = masks.crop(hiding, index)
        inside = masks.crop(masks.inside, index).astype(np.uint8)
        near = cv2.dilate(inside, np.ones((2 * NEAR_PX + 1,) * 2, np.uint8)) > 0
        own = cKDTree(projection.px[index].reshape(-1, 2))
        own_depth = projection.depth[index].ravel()
        corner, (rows, columns) = masks.corners[index], crop.shape
        for other, image in seen.items():
            px, depth = image.px[index].reshape(-1, 2), image.depth[index].ravel()
            if (px.max(0) < corner).any() or (px.min(0) > corner + (columns, rows)).any():
                continue
            drawn = draw_polygons(grid_quads(image.px[index]), (columns, rows), corner) >= 0.5
            shows = crop == other
            row, column = np.nonzero(near & shows | drawn & (shows | (crop == 0)) & (inside == 0))
            if not len(row):
                continue
            place = np.stack([column, row], 1) + 0.5 + corner
            gap = depth[cKDTree(px).query(place)[1]] - own_depth[own.query(place)[1]]
            is_front = drawn[row, column] & (gap < -margin)
            crop[row, column] = np.where(gap > margin, 0, np.where(is_front, other, crop[row, column]))
    return hiding
