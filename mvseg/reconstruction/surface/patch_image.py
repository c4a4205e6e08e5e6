"""Images of a patch: its projection, the pixels that it covers, and which neighbours lie behind it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import IMAGE, STACK
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


def view_ious(masks: MaskStack, points: Floats, *, offsets: Floats) -> Floats:
    """(S,) IoU of grid points (rows, columns, 3) of a patch and the mask in each view, where nothing else hides it.
    With `offsets` (S,), pixels, the patch is drawn as much too large or small as the mask of each view is."""
    shares = draw_patch(masks, project_points(masks.px_from_world, points), offsets=offsets, is_blurred=False)
    return crop_ious(masks, shares >= 0.5)


def crop_ious(masks: MaskStack, covered: NDArray[np.bool_], *, offsets: Floats | None = None) -> Floats:
    """(S,) IoU of covered pixels (S, H, W) and the mask in each view, where nothing else hides them; masks are made
    smaller by `offsets` (S,), pixels."""
    inside = masks.inside if offsets is None else masks.depth_px > offsets[:, None, None]
    covered = covered & (masks.others == 0)
    common, either = (np.array(list(map(np.count_nonzero, each))) for each in (covered & inside, covered | inside))
    return np.asarray(common / np.maximum(either, 1))


def draw_patch(
    masks: MaskStack, projection: Projection, *, offsets: Floats | None = None, is_blurred: bool = True
) -> NDArray[np.float32]:
    """(S, H, W) the projected grid as a blurred mask, like `MaskStack.blurred`, or sharp. With `offsets` (S,), pixels,
    it is grown or shrunk as the mask of each view seems to be."""
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
    return np.asarray(np.where(is_near if px > 0 else is_away & ~is_near, np.uint8(255), np.uint8(0)))


def fill_grids(canvases: Iterable[NDArray[np.uint8]], px: Floats) -> None:
    """Set the pixels of S canvases (H, W) that projected grids (S, rows, columns, 2) cover to 255.

    The rim as one polygon has all pixels under an odd number of layers. Where there are two, one of them is seen from
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
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def grid_quads(grid: Floats) -> Floats:
    """(quads, 4, n) corners in turn of the cells of a grid (rows, columns, n)."""
    return grid.reshape(-1, grid.shape[-1])[_quad_places(*grid.shape[:2])]


@cache
def _quad_places(rows: int, columns: int) -> NDArray[np.int64]:
    """(quads, 4) the corners in turn of each cell, as places in a flat grid."""
    place = np.arange(rows * columns).reshape(rows, columns)
    return np.stack([place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1]], 2).reshape(-1, 4)


def draw_polygons(polygons: Floats, size: tuple[int, int], corner: Floats) -> NDArray[np.float32]:
    """(height, width) share of each pixel that quads (T, 4, 2) cover. Drawn several times as large. OpenCV's polygons
    include their border: they are `IMAGE.drawn_too_far` small pixels too wide on every side."""
    canvas = np.zeros((size[1] * IMAGE.supersampled, size[0] * IMAGE.supersampled), np.uint8)
    first, second = polygons[:, 2] - polygons[:, 0], polygons[:, 3] - polygons[:, 1]
    is_front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0
    local = _fixed((polygons - corner) * IMAGE.supersampled)
    for side in (local[is_front], local[~is_front]):  # where two of one side meet, their edge counts twice: as inside
        cv2.fillPoly(canvas, list(side), 255, shift=IMAGE.sub_pixel_bits)
    return _shares(canvas, size)


def _shares(canvas: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), np.float32) / np.float32(255)


def select_hiding(masks: MaskStack, points: Floats, others: Mapping[int, Floats]) -> dict[int, Floats]:
    """Select the others that can change an answer of `hiding_pixels`: in some view, their grid or a pixel that shows
    them comes near the leaf's grid or mask."""
    px = project_points(masks.px_from_world, points).px.reshape(len(masks), -1, 2)
    low, high = px.min(1), px.max(1)
    for view, inside in enumerate(masks.inside):
        (rows, columns), room = np.nonzero(inside), IMAGE.near_px + 1
        if len(rows):
            low[view] = np.minimum(low[view], (columns.min(), rows.min())) - room
            high[view] = np.maximum(high[view], (columns.max(), rows.max())) + room
    first = np.clip(np.floor(low), 0, None).astype(int)
    last = np.clip(np.ceil(high), 0, None).astype(int) + 1
    around = zip(masks.others, first.tolist(), last.tolist(), strict=True)
    ids = {int(each) for crop, (x1, y1), (x2, y2) in around for each in np.unique(crop[y1:y2, x1:x2])}
    near = {}
    for other, grid in others.items():
        image = project_points(masks.px_from_world, grid).px.reshape(len(masks), -1, 2)
        if other in ids or ((image.max(1) >= low).all(1) & (image.min(1) <= high).all(1)).any():
            near[other] = grid
    return near


def hiding_pixels(
    masks: MaskStack, points: Floats, others: Mapping[int, Floats], *, margin: float
) -> NDArray[np.int32]:
    """(S, H, W) int32: which instance hides the leaf there, 0 for none, as the surfaces have it.

    A pixel that shows another instance hides nothing where its surface lies behind the leaf. A surface in front of the
    leaf hides it, whether that instance has a mask there or not. The order of the others only decides which of several
    ids a pixel has.

    Args:
        points: (rows, columns, 3) grid points of the leaf's present patch.
        others: instance id -> grid points of its patch. Instances without a patch may hide anything.
        margin: world units by which another one must be farther away to lie behind, or nearer to lie in front.
    """
    hiding = masks.others.copy()
    projection = project_points(masks.px_from_world, points)
    images = {other: project_points(masks.px_from_world, grid) for other, grid in others.items()}
    leaves = (masks.inside | (cover_crops(masks, projection) > 0)).astype(np.uint8)
    size = masks.size[::-1]
    for index, crop in enumerate(hiding):
        near = cv2.dilate(leaves[index], np.ones((2 * IMAGE.near_px + 1,) * 2, np.uint8)) > 0
        near &= ~masks.inside[index]
        own, own_depth = cKDTree(projection.px[index].reshape(-1, 2)), projection.depth[index].ravel()
        there = {}
        for other, image in images.items():
            px = image.px[index].reshape(-1, 2)
            if (px.max(0) >= 0).all() and (px.min(0) <= size).all():
                there[other] = cKDTree(px), image.depth[index].ravel()
        behind = np.zeros(crop.shape, bool)
        for other, surface in there.items():
            shown = np.argwhere(near & (crop == other))
            if len(shown):
                behind[tuple(shown.T)] = _gaps(shown, surface, (own, own_depth)) > margin
        crop[behind] = 0
        for other, surface in there.items():
            canvas = np.zeros((size[1] * IMAGE.supersampled, size[0] * IMAGE.supersampled), np.uint8)
            fill_grids([canvas], images[other].px[index : index + 1] * IMAGE.supersampled)
            drawn = np.argwhere(near & (crop == 0) & (_shares(canvas, size) >= 0.5))
            if len(drawn):
                crop[tuple(drawn[_gaps(drawn, surface, (own, own_depth)) < -margin].T)] = other
    return hiding


def _gaps(places: NDArray[np.int64], surface: tuple[cKDTree, Floats], own: tuple[cKDTree, Floats]) -> Floats:
    """(P,) how much farther a surface is than the own one at pixels (P, 2); each as image points and depths."""
    centres = places[:, ::-1] + 0.5
    far, near = (depth[tree.query(centres)[1]] for tree, depth in (surface, own))
    return np.asarray(far - near)
