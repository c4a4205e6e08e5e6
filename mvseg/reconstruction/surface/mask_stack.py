"""The masks of one leaf, ready for its fit: blurred, with samples of their edges, and with what may hide the leaf."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

from mvseg.reconstruction.surface.leaf_patch import Floats

BLUR_PX = 0.8  # of the masks: makes their edges smooth functions of the position
MARGIN = 24  # pixels around a mask that are kept; around a large one more
LARGE_PX = 60.0  # side of a square mask from which distances grow with the masks
EDGE_SAMPLES = 40  # of each mask's edge
FRAME = -1  # label of what lies outside the image
Labels = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class MaskStack:
    """The masks of one leaf in its S views, as crops that stand one after another in flat arrays.

    Attributes:
        views: (S,) view indices.
        px_from_world: (S, 3, 4).
        corners: (S, 2) x, y of the top-left pixel of each crop.
        shapes: (S, 2) rows and columns of each crop.
        starts: (S,) where each crop begins in the flat arrays.
        blurred: (pixels,) float32, the mask, blurred; 0.5 is its edge.
        inside: (pixels,) bool, the mask.
        others: (pixels,) int32, instance that hides the leaf there, 0 for none, FRAME outside the image.
        edge_px: (E, 2) samples of the edges of the masks.
        edge_normals: (E, 2), outwards.
        edge_stack: (E,) place in `views` of each.
    """

    views: NDArray[np.int64]
    px_from_world: Floats
    corners: Floats
    shapes: NDArray[np.int64]
    starts: NDArray[np.int64]
    blurred: NDArray[np.float32]
    inside: NDArray[np.bool_]
    others: Labels
    edge_px: Floats
    edge_normals: Floats
    edge_stack: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.views)

    @property
    def enlargement(self) -> float:
        """By how much the masks are larger than small ones, at least 1: first errors in pixels grow with it."""
        return mask_enlargement(np.add.reduceat(self.inside, self.starts))

    def crop(self, values: NDArray, index: int) -> NDArray:
        """(rows, columns) view into one of the flat arrays."""
        rows, columns = self.shapes[index]
        return values[self.starts[index] : self.starts[index] + rows * columns].reshape(rows, columns)

    def look_up(self, values: NDArray, stack: NDArray, px: Floats) -> NDArray:
        """Values of the pixels that the positions (P, 2) lie in; positions outside a crop get its border pixel."""
        local = np.floor(px - self.corners[stack]).astype(np.int64)
        rows, columns = self.shapes[stack].T
        column, row = np.clip(local[:, 0], 0, columns - 1), np.clip(local[:, 1], 0, rows - 1)
        return values[self.starts[stack] + row * columns + column]

    def interpolate(self, values: NDArray[np.float32], stack: NDArray, px: Floats) -> NDArray[np.float32]:
        """(P, T) of one of the flat arrays at positions (P, T, 2), bilinear between pixel centres."""
        local = (px - self.corners[stack][:, None] - 0.5).astype(np.float32)
        rows, columns = (self.shapes[stack][:, None, axis] for axis in (0, 1))
        x = np.clip(local[..., 0], 0, columns - 1.001)
        y = np.clip(local[..., 1], 0, rows - 1.001)
        column, row = x.astype(np.int64), y.astype(np.int64)
        x, y = x - column, y - row
        first = self.starts[stack][:, None] + row * columns + column
        below = first + columns
        top = values[first] * (1 - x) + values[first + 1] * x
        bottom = values[below] * (1 - x) + values[below + 1] * x
        return top * (1 - y) + bottom * y

    def select(self, keep: NDArray[np.bool_]) -> MaskStack:
        """Only the views (S,) that are to be kept."""
        pick = np.flatnonzero(keep)
        sizes = self.shapes.prod(1)
        pixels = np.repeat(keep, sizes)
        edges = keep[self.edge_stack]
        place = np.cumsum(keep) - 1
        return MaskStack(
            views=self.views[pick],
            px_from_world=self.px_from_world[pick],
            corners=self.corners[pick],
            shapes=self.shapes[pick],
            starts=np.cumsum(sizes[pick]) - sizes[pick],
            blurred=self.blurred[pixels],
            inside=self.inside[pixels],
            others=self.others[pixels],
            edge_px=self.edge_px[edges],
            edge_normals=self.edge_normals[edges],
            edge_stack=place[self.edge_stack[edges]],
        )

    def with_others(self, others: Labels) -> MaskStack:
        """The same masks, with what hides the leaf as (pixels,) int32."""
        return replace(self, others=others)

    def move_world(self, centre: Floats, scale: float) -> MaskStack:
        """The same masks for world coordinates (x - centre) / scale; depths are divided by `scale`, too."""
        shift = self.px_from_world[:, :, :3] @ centre + self.px_from_world[:, :, 3]
        matrices = np.concatenate([self.px_from_world[:, :, :3], shift[:, :, None] / scale], 2)
        return replace(self, px_from_world=matrices)


def stack_masks(
    masks: Sequence[NDArray[np.bool_]],
    others: Sequence[Labels],
    views: Sequence[int],
    *,
    px_from_world: Floats,
    mask_corners: Sequence[tuple[int, int]] | None = None,
    own: int = 0,
) -> MaskStack:
    """The outlines of one leaf.

    Args:
        masks: S frames of its own pixels, each with at least one: full ones (H, W), or parts (h, w) of these.
        others: S full frames (H, W) with the ids (> 0) of other instances, 0 elsewhere.
        views: the view index of each.
        px_from_world: (S, 3, 4), pixel centres at half integers.
        mask_corners: x, y of the top-left pixel of each mask that is a part.
        own: the id of the leaf itself, which hides nothing, in `others`.
    """
    mask_corners = [(0, 0)] * len(masks) if mask_corners is None else mask_corners
    margin = round(MARGIN * mask_enlargement(np.array([mask.sum() for mask in masks])))
    corners, shapes, blurs, insides, hiding, edges = [], [], [], [], [], []
    for mask, (left, top), other in zip(masks, mask_corners, others, strict=True):
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        crop = np.pad(mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], margin)
        x1, y1 = left + int(columns[0]) - margin, top + int(rows[0]) - margin
        around = _cut(other, (x1, y1), (crop.shape[1], crop.shape[0]))
        around[around == own] = 0
        blurred = cv2.GaussianBlur(crop.astype(np.float32), (0, 0), BLUR_PX)
        corner = np.array([x1, y1], float)
        corners.append(corner)
        shapes.append(crop.shape)
        blurs.append(blurred.ravel())
        insides.append(crop.ravel())
        hiding.append(np.where(crop, 0, around).ravel())
        edges.append(_edge_samples(blurred, corner))
    sizes = np.array([len(blur) for blur in blurs])
    return MaskStack(
        views=np.asarray(views, dtype=np.int64),
        px_from_world=np.asarray(px_from_world, dtype=float),
        corners=np.stack(corners),
        shapes=np.array(shapes, dtype=np.int64),
        starts=np.cumsum(sizes) - sizes,
        blurred=np.concatenate(blurs),
        inside=np.concatenate(insides),
        others=np.concatenate(hiding).astype(np.int32),
        edge_px=np.concatenate([px for px, _ in edges]),
        edge_normals=np.concatenate([normals for _, normals in edges]),
        edge_stack=np.repeat(np.arange(len(edges)), [len(px) for px, _ in edges]),
    )


def mask_enlargement(num_pixels: NDArray) -> float:
    """At least 1; of masks of (S,) pixels."""
    return max(1.0, float(np.sqrt(np.median(num_pixels))) / LARGE_PX)


def _cut(frame: Labels, corner: tuple[int, int], size: tuple[int, int]) -> Labels:
    """(rows, columns) of a frame from a corner on; FRAME outside of it."""
    crop = np.full((size[1], size[0]), FRAME, np.int32)
    x1, y1 = max(corner[0], 0), max(corner[1], 0)
    x2, y2 = min(corner[0] + size[0], frame.shape[1]), min(corner[1] + size[1], frame.shape[0])
    crop[y1 - corner[1] : y2 - corner[1], x1 - corner[0] : x2 - corner[0]] = frame[y1:y2, x1:x2]
    return crop


def _edge_samples(blurred: NDArray, corner: Floats) -> tuple[Floats, Floats]:
    """Positions and outward normals (E, 2) along the level 0.5, evenly spread over its longer pieces."""
    lines = [line for line in find_contours(blurred, 0.5) if len(line) >= 12]
    total = sum(len(line) for line in lines)
    px, normals = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for line in lines:
        count = max(4, round(EDGE_SAMPLES * len(line) / total))
        pick = np.linspace(0, len(line) - 1, count, endpoint=False).astype(int)
        tangent = line[(pick + 3) % (len(line) - 1)] - line[(pick - 3) % (len(line) - 1)]
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        across = np.stack([-tangent[:, 1], tangent[:, 0]], 1)  # row, column, as `find_contours` has them
        ahead, back = (blurred[tuple(np.round(line[pick] + side * across).astype(int).T)] for side in (1, -1))
        across = across if ahead.sum() < back.sum() else -across
        normals.append(across[:, ::-1])
        px.append(line[pick][:, ::-1] + 0.5 + corner)
    return np.concatenate(px), np.concatenate(normals)
