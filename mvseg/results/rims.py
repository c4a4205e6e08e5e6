"""The rims of surfaces as the cameras see them, without the parts that other surfaces hide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.patch_image import grid_quads
from mvseg.scene import Cameras

Floats = NDArray[np.float64]
Rims = Mapping[int, list[Floats]]

COARSE = (24, 5)  # grid of a surface that may hide another one's rim
MAX_SIDE = 800  # pixels of the picture in which it is looked up
CURL = 0.05  # of a leaf's length, by which a part of it lies nearer than the rim that it hides
FLICKER = 7  # points of a rim; what is seen or hidden for less than half of that is a matter of rounding
OUTSIDE = 2.0  # widths or heights of the photo, beyond which nothing is drawn


def visible_rims(surfaces: Mapping[int, LeafSurface], cameras: Cameras) -> list[Rims]:
    """Where the photos show the rims of credible surfaces; the others are left out, and hide nothing.

    A part is hidden where a cell of a surface lies before it; one of its own leaf, where that is clearly nearer. Stems,
    pots and shapes of voxels hide nothing.

    Args:
        surfaces: {instance id: surface}.
        cameras: V cameras.

    Returns:
        V times {instance id: lines}, each (n, 2) float64 pixel positions of a part that is seen, n > 1; a rim that is
        seen as a whole is one line that ends where it starts.
    """
    shown = {instance: surface for instance, surface in surfaces.items() if surface.is_credible}
    if not shown:
        return [{} for _ in range(len(cameras))]
    cameras = cameras.to("cpu")
    rims = [surface.rim for surface in shown.values()]
    rim_px, rim_depth = (found.numpy() for found in cameras.project(torch.cat(rims)))
    grids = torch.stack([surface.points(*COARSE) for surface in shown.values()])
    grid_px, grid_depth = (found.numpy() for found in cameras.project(grids.reshape(-1, 3)))
    owner = np.repeat(np.arange(len(shown)), [len(rim) for rim in rims])
    curl = CURL * np.array([surface.length for surface in shown.values()])[owner]
    views: list[Rims] = []
    for view, size in enumerate(cameras.sizes.numpy()):
        px, depth = rim_px[view], rim_depth[view]
        with np.errstate(invalid="ignore"):
            is_near = np.all(np.abs(px - size / 2) < OUTSIDE * size, axis=1) & (depth > 0)
        px = np.where(is_near[:, None], px, -1.0)
        grid = np.concatenate((grid_px[view], grid_depth[view][:, None]), 1).reshape(len(shown), *COARSE, 3)
        points = _Points(px=px, depth=depth, owner=owner, curl=curl)
        is_seen = ~_is_hidden(points, grid, size)
        lines = {}
        for number, instance in enumerate(shown):
            of_rim = owner == number
            smooth = ndimage.median_filter(is_seen[of_rim].astype(np.uint8), FLICKER, mode="wrap") > 0
            lines[instance] = _cut(px[of_rim], smooth & is_near[of_rim])
        views.append({instance: parts for instance, parts in lines.items() if parts})
    return views


@dataclass(frozen=True, eq=False)
class _Points:
    """Points of rims: px (P, 2), depth (P,), number of their surface (P,), and by how much a cell of that surface must
    be nearer to hide them (P,)."""

    px: Floats
    depth: Floats
    owner: NDArray[np.int64]
    curl: Floats


def _is_hidden(points: _Points, grid: Floats, size: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(P,) whether the nearest cell at each point lies, as a whole, before the point.

    Args:
        points: P points.
        grid: (S, rows, columns, 3) pixel positions and depths of all surfaces.
        size: (2,) width and height of the photo.
    """
    scale = min(1.0, MAX_SIDE / int(size.max()))
    width, height = np.ceil(size * scale).astype(int).tolist()
    cells = np.stack([grid_quads(one) for one in grid])  # (S, cells, 4, 3)
    surface = np.repeat(np.arange(len(cells)), cells.shape[1])
    cells = cells.reshape(-1, 4, 3)
    is_ahead = np.all(cells[..., 2] > 0, axis=1)
    farthest = cells[..., 2].max(1)
    first = np.full((height, width), -1, np.int32)
    for cell in np.argsort(-farthest):  # far ones first: near ones are painted over them
        if is_ahead[cell]:
            corners = np.clip(np.round(cells[cell, :, :2] * scale - 0.5), -1e4, 1e4).astype(np.int32)
            cv2.fillConvexPoly(first, corners, int(cell))
    column, row = np.floor(points.px * scale).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.where(inside, first[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], -1)
    reach = np.where(surface[found] == points.owner, points.curl, 0.0)
    return (found >= 0) & (farthest[found] < points.depth - reach)


def _cut(line: Floats, is_seen: NDArray[np.bool_]) -> list[Floats]:
    """The parts of a closed line (P, 2) that are seen."""
    if is_seen.all():
        return [np.concatenate((line, line[:1]))]
    start = int(is_seen.argmin())
    line, is_seen = np.roll(line, -start, axis=0), np.roll(is_seen, -start)
    parts = np.split(line, np.flatnonzero(np.diff(is_seen)) + 1)  # by turns hidden and seen
    return [part for part in parts[1::2] if len(part) > 1]
