"""The masks of one leaf, ready for its fit: blurred, with samples of their edges, and whatever may hide the leaf.

Large masks are made smaller first: outlines need no more than `STACK.large_px` pixels across a leaf, and photos of any
size cost the same. Positions are in pixels of these crops, each from its own top-left corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import STACK
from mvseg.table import Table

FRAME = -1  # definition: what lies outside the image has this label
Labels = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class MaskStack(Table):
    """The masks of one leaf in its S views, as crops (S, H, W) of one size; or of several leaves, see `join_stacks`.

    Attributes:
        leaf: (S,) int64, place of the leaf among those that were joined; 0 of one leaf.
        sides: (S, 2) int64, columns and rows of each crop, which begins at the top left of (H, W).
        views: (S,) view indices.
        px_from_world: (S, 3, 4) to pixels of the crops.
        pixel_size: side of a pixel of a crop, in pixels of the photo.
        blurred: (S, H, W) float32, the mask, blurred; 0.5 is its edge.
        inside: (S, H, W) bool, the mask.
        others: (S, H, W) int32, instance that hides the leaf there, 0 for none, FRAME outside the image.
        edge_px: (E, 2) samples of the edges of the masks.
        edge_normals: (E, 2), outwards.
        edge_stack: (E,) place in `views` of each.
        axes: (3, 3) in rows, of the leaf itself (`find_axes`).
    """

    leaf: NDArray[np.int64]
    sides: NDArray[np.int64]
    views: NDArray[np.int64]
    px_from_world: Floats
    pixel_size: int
    blurred: NDArray[np.float32]
    inside: NDArray[np.bool_]
    others: Labels
    edge_px: Floats
    edge_normals: Floats
    edge_stack: NDArray[np.int64]
    axes: Floats

    @cached_property
    def depth_px(self) -> NDArray[np.float32]:
        """(S, H, W) how deep in the mask a pixel lies: its centre's distance from the edge, negative outside."""
        inside = self.inside.astype(np.uint8)
        away = [[cv2.distanceTransform(side, cv2.DIST_L2, 3) for side in (mask, 1 - mask)] for mask in inside]
        return np.array([np.maximum(within - 0.5, 0) - np.maximum(beyond - 0.5, 0) for within, beyond in away])

    @cached_property
    def edge_places(self) -> NDArray[np.int64]:
        """(S, most) `places_of_views` of the samples of the edges."""
        return places_of_views(self.edge_stack, len(self))

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a crop."""
        return self.inside.shape[1], self.inside.shape[2]

    def look_up(self, values: NDArray, stack: NDArray, px: Floats) -> NDArray:
        """Values (S, H, W) of the pixels that the positions (P, 2) lie in; outside of a crop those of its border."""
        return np.asarray(values.ravel().take(self.place_of(stack, px)))

    def place_of(self, stack: NDArray, px: Floats) -> NDArray[np.int64]:
        """(P,) where `look_up` looks in flat values."""
        rows, columns = self.size
        last = (self.sides - 1).T
        column = np.minimum(np.maximum(px[:, 0], 0), last[0].take(stack)).astype(np.int64)
        row = np.minimum(np.maximum(px[:, 1], 0), last[1].take(stack)).astype(np.int64)
        return np.asarray((stack * rows + row) * columns + column)

    def interpolate(self, values: NDArray[np.float32], stack: NDArray, px: Floats) -> NDArray[np.floating]:
        """(P, T) of values (S, H, W) at positions (P, T, 2), bilinear between pixel centres."""
        rows, columns = self.size
        last = (self.sides - 1.001).T[:, stack, None]
        x = np.minimum(np.maximum(px[..., 0] - 0.5, 0), last[0]).astype(np.float32)
        y = np.minimum(np.maximum(px[..., 1] - 0.5, 0), last[1]).astype(np.float32)
        column, row = x.astype(np.int64), y.astype(np.int64)
        x, y = x - column, y - row
        left, above = 1 - x, 1 - y
        flat = values.ravel()
        first = (stack[:, None] * rows + row) * columns + column
        top = flat.take(first) * left + flat[1:].take(first) * x
        bottom = flat[columns:].take(first) * left + flat[columns + 1 :].take(first) * x
        return top * above + bottom * y

    @property
    def columns(self) -> dict[str, Any]:
        """Columns with a row for each view."""
        beside = "edge_px", "edge_normals", "edge_stack", "axes"
        return {name: each for name, each in super().columns.items() if name not in beside}

    def _pick_rows(self, index: NDArray) -> dict[str, Any]:
        place = np.full(len(self), -1)
        place[index] = np.arange(len(index))
        edges = (stack := place[self.edge_stack]) >= 0
        of_edges = {"edge_px": self.edge_px[edges], "edge_normals": self.edge_normals[edges]}
        return super()._pick_rows(index) | of_edges | {"edge_stack": stack[edges]}

    def turn_world(self, axes: Floats) -> MaskStack:
        """The same masks for world coordinates along orthonormal axes (3, 3), in rows."""
        matrices = np.concatenate([self.px_from_world[:, :, :3] @ axes.T, self.px_from_world[:, :, 3:]], 2)
        return replace(self, px_from_world=matrices, axes=self.axes @ axes.T)

    def move_worlds(self, centres: Floats, scales: Floats) -> MaskStack:
        """The same masks for world coordinates (x - centre) / scale (L, 3), (L,) of each leaf; depths scale, too."""
        shift = (self.px_from_world[:, :, :3] @ centres[self.leaf, :, None])[..., 0] + self.px_from_world[:, :, 3]
        shift = shift / scales[self.leaf, None]
        return replace(self, px_from_world=np.concatenate([self.px_from_world[:, :, :3], shift[:, :, None]], 2))

    def split(self, values: NDArray) -> list[NDArray]:
        """Values (S, ...) of the views of each leaf."""
        return np.split(values, np.flatnonzero(np.diff(self.leaf)) + 1)


def join_stacks(stacks: Sequence[MaskStack]) -> MaskStack:
    """The masks of several leaves, so that one call works on all of them; `axes` and `pixel_size` mean nothing."""
    counts = [len(each) for each in stacks]
    first = np.cumsum([0, *counts[:-1]])
    rows, columns = np.max([each.size for each in stacks], 0)

    def pad(name: str, beyond: int = 0) -> NDArray:
        crops = [getattr(each, name) for each in stacks]
        padded = np.full((sum(counts), rows, columns), beyond, crops[0].dtype)
        for begin, count, crop in zip(first, counts, crops, strict=True):
            padded[begin : begin + count, : crop.shape[1], : crop.shape[2]] = crop
        return padded

    def chain(name: str) -> NDArray:
        return np.concatenate([getattr(each, name) for each in stacks])

    return MaskStack(
        leaf=np.repeat(np.arange(len(stacks)), counts),
        sides=chain("sides"),
        views=chain("views"),
        px_from_world=chain("px_from_world"),
        pixel_size=0,
        blurred=pad("blurred"),
        inside=pad("inside"),
        others=pad("others", beyond=FRAME),
        edge_px=chain("edge_px"),
        edge_normals=chain("edge_normals"),
        edge_stack=np.concatenate([each.edge_stack + begin for each, begin in zip(stacks, first, strict=True)]),
        axes=np.full((3, 3), np.nan),
    )


def stack_masks(
    masks: Sequence[NDArray[np.bool_]],
    others: Sequence[Labels],
    views: Sequence[int],
    *,
    px_from_world: Floats,
    mask_corners: Sequence[tuple[int, int]] | None = None,
    own: int = 0,
    axes: Floats | None = None,
) -> MaskStack:
    """The outlines of one leaf.

    Args:
        masks: S frames of its own pixels, each with at least one: full ones (H, W), or parts (h, w) of these.
        others: S full frames (H, W) with the ids (> 0) of other instances, 0 elsewhere.
        px_from_world: (S, 3, 4), pixel centres at half integers.
        mask_corners: x, y of the top-left pixel of each mask that is a part.
        own: the id of the leaf itself, which hides nothing, in `others`.
        axes: of the leaf; None: those of the world.
    """
    mask_corners = [(0, 0)] * len(masks) if mask_corners is None else mask_corners
    places = [(np.flatnonzero(mask.any(0))[[0, -1]], np.flatnonzero(mask.any(1))[[0, -1]]) for mask in masks]
    sides = np.array([(rows[1] - rows[0] + 1, columns[1] - columns[0] + 1) for columns, rows in places])
    scale = choose_pixel_size([int(mask.sum()) for mask in masks], int(sides.max()))
    rows, columns = (-(-side // scale) + 2 * STACK.margin for side in sides.max(0).tolist())
    shape = (len(masks), rows, columns)
    blurred, inside, hiding = np.zeros(shape, np.float32), np.zeros(shape, bool), np.zeros(shape, np.int32)
    px_from_world = np.array(px_from_world, dtype=float)
    for index, (mask, (left, top), (across, down)) in enumerate(zip(masks, mask_corners, places, strict=True)):
        x, y = int(across[0]) - scale * STACK.margin, int(down[0]) - scale * STACK.margin
        around = _cut(others[index], (x + left, y + top), (columns * scale, rows * scale), beyond=FRAME)
        around = around[scale // 2 :: scale, scale // 2 :: scale]
        own_part = _cut(mask, (x, y), (columns * scale, rows * scale), beyond=0).astype(np.float32)
        share = cv2.resize(own_part, (columns, rows), interpolation=cv2.INTER_AREA)
        cv2.GaussianBlur(share, (0, 0), STACK.blur_px, dst=blurred[index])
        inside[index] = share >= min(0.5, share.max())  # a thin mask keeps its fullest pixels
        hiding[index] = np.where(inside[index] | (around == own), 0, around)
        matrix = px_from_world[index]
        matrix[:2] = (matrix[:2] - np.array([[x + left], [y + top]]) * matrix[2]) / scale
    edges = [_edge_samples(image) for image in blurred]
    return MaskStack(
        leaf=np.zeros(len(masks), np.int64),
        sides=np.tile((columns, rows), (len(masks), 1)),
        views=np.asarray(views, dtype=np.int64),
        px_from_world=px_from_world,
        pixel_size=scale,
        blurred=blurred,
        inside=inside,
        others=hiding,
        edge_px=np.concatenate([px for px, _ in edges]),
        edge_normals=np.concatenate([normals for _, normals in edges]),
        edge_stack=np.repeat(np.arange(len(edges)), [len(px) for px, _ in edges]),
        axes=np.eye(3) if axes is None else axes,
    )


def places_of_views(stack: NDArray, num_views: int) -> NDArray[np.int64]:
    """(S, most) the places in `stack` (N,) of the samples of each view, in order; -1 beyond the last one."""
    order = np.argsort(stack, kind="stable")
    counts = np.bincount(stack, minlength=num_views)
    places = np.full((num_views, counts.max(initial=0)), -1)
    ordered = stack[order]
    places[ordered, np.arange(len(stack)) - (np.cumsum(counts) - counts)[ordered]] = order
    return places


def choose_pixel_size(num_pixels: Sequence[int], longest: int) -> int:
    """At least 1, for masks of (S,) pixels the longest side of which is `longest`."""
    return max(1, round(float(np.sqrt(np.median(num_pixels))) / STACK.large_px), -(-longest // STACK.long_px))


def _cut(frame: NDArray, corner: tuple[int, int], size: tuple[int, int], *, beyond: int) -> NDArray:
    crop = np.full((size[1], size[0]), beyond, frame.dtype)
    x1, y1 = max(corner[0], 0), max(corner[1], 0)
    x2, y2 = min(corner[0] + size[0], frame.shape[1]), min(corner[1] + size[1], frame.shape[0])
    crop[y1 - corner[1] : y2 - corner[1], x1 - corner[0] : x2 - corner[0]] = frame[y1:y2, x1:x2]
    return crop


def _edge_samples(blurred: NDArray) -> tuple[Floats, Floats]:
    """Positions and outward normals (E, 2) along the level 0.5, evenly spread over its longer pieces."""
    lines = [line for line in find_contours(blurred, 0.5) if len(line) >= 12]
    total = sum(len(line) for line in lines)
    px, normals = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for line in lines:
        count = max(4, round(STACK.edge_samples * len(line) / total))
        pick = np.linspace(0, len(line) - 1, count, endpoint=False).astype(int)
        tangent = line[(pick + 3) % (len(line) - 1)] - line[(pick - 3) % (len(line) - 1)]
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        across = np.stack([-tangent[:, 1], tangent[:, 0]], 1)  # row, column, as `find_contours` has them
        ahead, back = (blurred[tuple(np.round(line[pick] + side * across).astype(int).T)] for side in (1, -1))
        across = across if ahead.sum() < back.sum() else -across
        normals.append(across[:, ::-1])
        px.append(line[pick][:, ::-1] + 0.5)
    return np.concatenate(px), np.concatenate(normals)
