"""What cameras see of a patch: its projection, the pixels that it covers, and which neighbours lie behind it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvseg.reconstruction.numbers import IMAGE, STACK
from mvseg.reconstruction.surface.leaf_patch import Floats
from mvseg.reconstruction.surface.mask_stack import MaskStack


@dataclass(frozen=True, eq=False)
class Projection:
    """A patch grid in S views: px (S, rows, columns, 2) and depths (S, rows, columns)."""

    px: Floats
    depth: Floats


def project_points(px_from_world: Floats, points: Floats) -> Projection:
    """Project grid points, ([S,] rows, columns, 3), by S matrices (S, 3, 4); depths are kept above zero."""
    flat = points.reshape(*points.shape[:-3], -1, 3)
    cam = flat @ px_from_world[:, :, :3].transpose(0, 2, 1) + px_from_world[:, None, :, 3]
    depth = np.maximum(cam[..., 2], 1e-9)
    shape = (len(px_from_world), *points.shape[-3:-1])
    px = np.empty((*depth.shape, 2))
    for axis in (0, 1):  # one after the other: broadcasting over two numbers is slow
        np.divide(cam[..., axis], depth, out=px[..., axis])
    return Projection(px=px.reshape(*shape, 2), depth=depth.reshape(shape))


def cover_crops(masks: MaskStack, projection: Projection) -> NDArray[np.uint8]:
    """(S, H, W) above 0 where a projected grid covers the crops; of a fine one every second row and column will do."""
    last = projection.px.shape[1] - 1
    rows, every = (np.unique(np.r_[0:last:2, last]), 2) if last > 20 else (np.arange(last + 1), 1)
    covered = np.zeros((len(masks), *masks.size), np.uint8)
    canvases = [canvas[:high, :wide] for canvas, (wide, high) in zip(covered, masks.sides.tolist(), strict=True)]
    fill_grids(canvases, projection.px[:, rows, ::every])
    return covered


def view_ious(masks: MaskStack, points: Floats, *, offsets: Floats | None = None) -> Floats:
    """(S,) IoU of grid points (rows, columns, 3) of a patch and the mask in each view, where nothing else hides it.

    With `offsets` (S,), pixels, the patch is drawn as much too large or small as the mask of each view is.
    """
    shares = draw_patch(masks, project_points(masks.px_from_world, points), offsets=offsets, is_blurred=False)
    return crop_ious(masks, shares >= 0.5)


def crop_ious(masks: MaskStack, covered: NDArray[np.bool_], *, offsets: Floats | None = None) -> Floats:
    """(S,) IoU of covered pixels (S, H, W) and the mask in each view, where nothing else hides them.

    With `offsets` (S,), pixels, the masks are made as much smaller.
    """
    inside = masks.inside if offsets is None else masks.depth_px > offsets[:, None, None]
    covered = covered & (masks.others == 0)
    common, either = (np.array(list(map(np.count_nonzero, each))) for each in (covered & inside, covered | inside))
    ious: Floats = common / np.maximum(either, 1)
    return ious


def draw_patch(
    masks: MaskStack, projection: Projection, *, offsets: Floats | None = None, is_blurred: bool = True
) -> NDArray[np.float32]:
    """(S, H, W) the projected grid as a blurred mask, like `MaskStack.blurred`, or sharp.

    With `offsets` (S,), pixels, it is grown or shrunk as the mask of each view seems to be.
    """
    drawn = np.zeros((len(masks), *masks.size), np.float32)
    beside = IMAGE.drawn_beside + (0 if offsets is None else np.ceil(np.abs(offsets))[:, None])
    low = np.clip(np.floor(projection.px.min((1, 2))) - beside, 0, masks.sides).astype(int)
    high = np.clip(np.ceil(projection.px.max((1, 2))) + beside, 0, masks.sides).astype(int)
    canvases = [np.zeros((height, width), np.uint8) for width, height in (IMAGE.supersampled * (high - low)).tolist()]
    fill_grids(canvases, IMAGE.supersampled * (projection.px - low[:, None, None]))
    for index, canvas in enumerate(canvases):
        if not canvas.size:
            continue
        if offsets is not None and abs(offsets[index]) > IMAGE.least_growth_px:
            canvas = grow(canvas, IMAGE.supersampled * float(offsets[index]))
        (left, top), (right, bottom) = low[index], high[index]
        share = _shares(canvas, (right - left, bottom - top))
        drawn[index, top:bottom, left:right] = cv2.GaussianBlur(share, (0, 0), STACK.blur_px) if is_blurred else share
    return drawn


def grow(canvas: NDArray[np.uint8], px: float) -> NDArray[np.uint8]:
    """Pixels (rows, columns) of 0 or 255, grown by `px` pixels, or shrunk where that is negative."""
    is_away = canvas == 0 if px > 0 else canvas > 0
    # Distances are to pixel centres: the border is half a pixel nearer.
    is_near = cv2.distanceTransform(is_away.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) < abs(px) + 0.5
    grown: NDArray[np.uint8] = np.where(is_near if px > 0 else is_away & ~is_near, np.uint8(255), np.uint8(0))
    return grown


def fill_grids(canvases: Iterable[NDArray[np.uint8]], px: Floats) -> None:
    """Set the pixels of S canvases (H, W) that projected grids (S, rows, columns, 2) cover to 255.

    Its rim as one polygon has all pixels under an odd number of layers. Where there are two, one of them is seen from
    the other side: the quads of the side that shows fewer of them do the rest.
    """
    corners, quads = _fixed(px), _quad_places(*px.shape[1:3])
    rims = np.ascontiguousarray(np.concatenate([corners[:, :, 0], corners[:, -2:0:-1, -1]], 1))
    is_front = (grid_orientations(px) > 0).reshape(len(px), -1)
    is_rare = is_front == (2 * np.count_nonzero(is_front, axis=1) < is_front.shape[1])[:, None]
    corners = corners.reshape(len(px), -1, 2)
    for canvas, grid, rim, rare, folds in zip(canvases, corners, rims, is_rare, is_rare.any(1), strict=True):
        if canvas.size:
            cv2.fillPoly(canvas, [rim], 255, shift=IMAGE.sub_pixel_bits)
        if canvas.size and folds:
            cv2.fillPoly(canvas, list(grid[quads[rare]]), 255, shift=IMAGE.sub_pixel_bits)


def _fixed(px: Floats) -> NDArray[np.int32]:
    """Positions as OpenCV's polygons have them: whole numbers of small parts of a pixel, from its centre on."""
    most = 1 << (IMAGE.sub_pixel_bits + 13)
    return np.clip(np.round((px - 0.5) * (1 << IMAGE.sub_pixel_bits)), -most, most).astype(np.int32)


def grid_orientations(px: Floats) -> Floats:
    """(..., rows - 1, columns - 1) twice the signed areas of the cells of projected grids (..., rows, columns, 2)."""
    first = px[..., 1:, 1:, :] - px[..., :-1, :-1, :]
    second = px[..., 1:, :-1, :] - px[..., :-1, 1:, :]
    areas: Floats = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return areas


def grid_quads(grid: Floats) -> Floats:
    """(quads, 4, n) corners in turn of the cells of a grid (rows, columns, n)."""
    return grid.reshape(-1, grid.shape[-1])[_quad_places(*grid.shape[:2])]


@cache
def _quad_places(rows: int, columns: int) -> NDArray[np.int64]:
    """(quads, 4) the corners in turn of each cell, as places in a flat grid."""
    place = np.arange(rows * columns).reshape(rows, columns)
    return np.stack([place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1]], 2).reshape(-1, 4)


def draw_polygons(polygons: Floats, size: tuple[int, int], corner: Floats) -> NDArray[np.float32]:
    """(height, width) share of each pixel that quads (T, 4, 2) cover.

    Drawn several times as large. OpenCV's polygons include their border: they are `IMAGE.drawn_too_far` small pixels
    too wide on every side.
    """
    canvas = np.zeros((size[1] * IMAGE.supersampled, size[0] * IMAGE.supersampled), np.uint8)
    first, second = polygons[:, 2] - polygons[:, 0], polygons[:, 3] - polygons[:, 1]
    is_front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0
    local = _fixed((polygons - corner) * IMAGE.supersampled)
    for side in (local[is_front], local[~is_front]):  # where two of one side meet, their edge counts twice: as inside
        cv2.fillPoly(canvas, list(side), 255, shift=IMAGE.sub_pixel_bits)
    return _shares(canvas, size)


def _shares(canvas: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
    share: NDArray[np.float32] = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return share / np.float32(255)


def hiding_pixels(masks: MaskStack, points: Floats, others: dict[int, Floats], *, margin: float) -> NDArray[np.int32]:
    """(S, H, W) int32: which instance hides the leaf there, 0 for none, as the surfaces have it.

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
    leaves = (masks.inside | (cover_crops(masks, projection) > 0)).astype(np.uint8)
    size = masks.size[::-1]
    for index, crop in enumerate(hiding):
        near = cv2.dilate(leaves[index], np.ones((2 * IMAGE.near_px + 1,) * 2, np.uint8)) > 0
        near &= ~masks.inside[index]
        own = cKDTree(projection.px[index].reshape(-1, 2))
        own_depth = projection.depth[index].ravel()
        for other, image in seen.items():
            px, depth = image.px[index].reshape(-1, 2), image.depth[index].ravel()
            if (px.max(0) < 0).any() or (px.min(0) > size).any():
                continue
            canvas = np.zeros((size[1] * IMAGE.supersampled, size[0] * IMAGE.supersampled), np.uint8)
            fill_grids([canvas], image.px[index : index + 1] * IMAGE.supersampled)
            drawn = _shares(canvas, size) >= 0.5
            shows = crop == other
            row, column = np.nonzero(near & (shows | drawn & (crop == 0)))
            if not len(row):
                continue
            place = np.stack([column, row], 1) + 0.5
            gap = depth[cKDTree(px).query(place)[1]] - own_depth[own.query(place)[1]]
            is_front = drawn[row, column] & (gap < -margin)
            crop[row, column] = np.where(gap > margin, 0, np.where(is_front, other, crop[row, column]))
    return hiding
