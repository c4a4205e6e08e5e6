"""The outlines of one leaf's masks, and how far the outline of a patch is from them, in pixels.

Both ways: from samples of the patch's outline along their image normal to the mask's edge, and from samples of the
mask's edge to the nearest outline sample with a similar normal. Distances are signed: positive where the patch has to
grow. Where another instance or the frame hides the rest of the leaf, the mask's edge is not its rim: there the patch
only has to cover the mask, and a negative distance does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import IMAGE, OUTLINE
from mvseg.reconstruction.surface.leaf_patch import PatchGrid
from mvseg.reconstruction.surface.mask_stack import MaskStack, places_of_views
from mvseg.reconstruction.surface.patch_image import (
    Projection,
    cover_crops,
    draw_patch,
    grid_orientations,
    project_points,
)
from mvseg.table import Table


@dataclass(frozen=True, eq=False)
class OutlineSamples(Table):
    """K samples on the outline of a projected patch.

    Attributes:
        stack: (K,) place in `MaskStack.views`.
        px: (K, 2).
        normals: (K, 2) unit, outwards.
        place: (K,) int64, row of `PatchGrid.outline_basis`.
        depth: (K,).
    """

    stack: NDArray[np.int64]
    px: Floats
    normals: Floats
    place: NDArray[np.int64]
    depth: Floats


def outline_samples(
    masks: MaskStack, grid: PatchGrid, projection: Projection
) -> tuple[OutlineSamples, NDArray[np.uint8]]:
    """The visible outline of a patch in every view: its rim, and the folds that stand out against the background. Also
    (S, H, W) uint8, above 0 where the patch covers a pixel of `masks`."""
    samples = OutlineSamples.concatenate((_rim_samples(grid, projection), _fold_samples(grid, projection)))
    outside = samples.px + OUTLINE.outside_px * samples.normals
    covered = cover_crops(masks, projection)
    return samples.select(masks.look_up(covered, samples.stack, outside) == 0), covered


def _rim_samples(grid: PatchGrid, projection: Projection) -> OutlineSamples:
    place, inner = _rim_places(*grid.shape)
    num_views, count = len(projection.px), len(place)
    flat = projection.px.reshape(num_views, -1, 2)
    px = flat.take(place, 1)
    around = np.concatenate([px[:, -1:], px, px[:, :1]], 1)
    normals = _outwards(around[:, 2:] - around[:, :-2], px - flat.take(inner, 1))
    return OutlineSamples(
        stack=np.repeat(np.arange(num_views), count),
        px=px.reshape(-1, 2),
        normals=normals.reshape(-1, 2),
        place=np.tile(place, num_views),
        depth=projection.depth.reshape(num_views, -1).take(place, 1).ravel(),
    )


@cache
def _rim_places(rows: int, columns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n,) the points of the rim, as places in the flat grid, and for each a point that lies further inside."""
    down, up = np.arange(rows), np.arange(rows - 2, 0, -1)
    row = np.concatenate([down, up])
    column = np.concatenate([np.zeros(rows, int), np.full(rows - 2, columns - 1)])
    inner_row = np.clip(row, 1, rows - 2)
    inner_column = np.where(column == 0, 1, columns - 2)
    inner_column[[0, rows - 1]] = columns // 2
    return row * columns + column, inner_row * columns + inner_column


def _fold_samples(grid: PatchGrid, projection: Projection) -> OutlineSamples:
    """Middles of the grid edges between quads that are seen from different sides."""
    rows, columns = grid.shape
    px, depth, is_front = projection.px.reshape(-1, 2), projection.depth.ravel(), grid_orientations(projection.px) > 0

    def middles(corner: NDArray) -> Floats:
        return np.asarray(px[corner + columns + 1] + px[corner] + px[corner + columns] + px[corner + 1]) / 4

    parts = []
    # Edges from row to row, between quads side by side, and from column to column.
    for number, (to_next, differ) in enumerate(
        ((1, is_front[:, :, 1:] != is_front[:, :, :-1]), (columns, is_front[:, 1:] != is_front[:, :-1]))
    ):
        stack, row, column = np.nonzero(differ)
        corner = (stack * rows + row) * columns + column
        a, b = corner + to_next, corner + columns + 1
        first, second = px[a], px[b]
        inner = (middles(corner) + middles(a)) / 2
        middle = (first + second) / 2
        parts.append(
            OutlineSamples(
                stack=stack,
                px=middle,
                normals=_outwards(second - first, middle - inner),
                place=(number + 1) * rows * columns + row * columns + column + to_next,
                depth=depth[a],
            )
        )
    return OutlineSamples.concatenate(parts)


def _outwards(tangent: Floats, away: Floats) -> Floats:
    """Unit normals of tangents (..., 2) on the side that `away` points to."""
    x, y = tangent[..., 1], -tangent[..., 0]
    length = np.maximum(np.sqrt(x * x + y * y), 1e-9)
    length = np.where(x * away[..., 0] + y * away[..., 1] < 0, -length, length)
    return np.stack([x / length, y / length], -1)


@dataclass(frozen=True, eq=False)
class Distances(Table):
    """N signed distances and their dependencies.

    Attributes:
        stack: (N,) place in `MaskStack.views`.
        px: (N,) how far the patch has to move outwards, pixels.
        place: (N,) row of `PatchGrid.outline_basis`, of `grid`, of the patch point.
        gradient: (N, 3) change of the pixel position along the normal per world unit.
        weight: (N,).
        leaf: (N,) place of the patch among L patches.
    """

    stack: NDArray[np.int64]
    px: Floats
    place: NDArray[np.int64]
    gradient: Floats
    weight: Floats
    grid: PatchGrid
    leaf: NDArray[np.int64]
    num_leaves: int

    @property
    def jacobian(self) -> Floats:
        """(N, 78) change along the normal per coefficient."""
        basis = self.grid.outline_basis[self.place]
        return (basis[:, :, None] * self.gradient[:, None, :]).reshape(len(self.px), 3 * basis.shape[1])

    def normal_equations(self, px: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """J' W J (L, 78, 78) and J' W px (L, 78) of the jacobian J of each patch, for distances and weights (N,). The
        same place is seen in many views, so it is summed over them before it is spread over coefficients."""
        num_places = len(self.grid.outline_basis)
        place = self.leaf * num_places + self.place
        is_asked = np.bincount(place, minlength=self.num_leaves * num_places) > 0
        places, index = np.flatnonzero(is_asked), (is_asked.cumsum() - 1)[place]
        basis = self.grid.outline_basis[places % num_places]
        ahead = np.ascontiguousarray(self.gradient.T)
        pulled = ahead * weight
        asked = np.stack([np.bincount(index, by * along, len(places)) for by in (*ahead, px) for along in pulled], 1)
        size = basis.shape[1]
        spread = (asked[:, :9, None] * basis[:, None]).reshape(len(places), 9 * size)
        ends = np.searchsorted(places, num_places * np.arange(self.num_leaves + 1))
        parts = [slice(*each) for each in pairwise(ends.tolist())]
        matrices = np.array([basis[part].T @ spread[part] for part in parts])
        matrices = matrices.reshape(-1, size, 3, 3, size).transpose(0, 1, 2, 4, 3)
        right = np.array([basis[part].T @ asked[part, 9:] for part in parts])
        return matrices.reshape(-1, 3 * size, 3 * size), right.reshape(-1, 3 * size)


def outline_distances(
    masks: MaskStack,
    grid: PatchGrid,
    coefficients: Floats,
    *,
    reach: float,
    is_imaged: bool,
    offsets: Floats | None = None,
) -> Distances:
    """How far the outline of the patch is from the edges of its masks, both ways; edges beyond `reach` do not count.

    `coefficients` (26, 3), or (L, 26, 3) where the masks of L leaves are joined.
    With `is_imaged` the patch is drawn and blurred as the masks are, and its own edge takes the place of its outline:
    tips narrower than a pixel and notches lose the same on both sides. Worth it when the two are near each other.
    With `offsets` (S,), pixels, it is drawn as much too large or small as the masks of each view are.
    """
    coefficients = coefficients.reshape(-1, *coefficients.shape[-2:])
    projection = project_points(masks.px_from_world, grid.points(coefficients)[masks.leaf])
    samples, covered = outline_samples(masks, grid, projection)
    offsets = np.zeros(len(masks)) if offsets is None else offsets
    to_edge, hidden = search_edges(masks, samples, masks.blurred, reach=reach, offsets=offsets)
    shift = np.zeros(len(to_edge))
    if is_imaged:
        drawn = draw_patch(masks, projection, offsets=offsets)
        most = OUTLINE.most_shift_px + float(np.abs(offsets).max(initial=0))
        shift = search_edges(masks, samples, drawn, reach=most, offsets=offsets)[0]
        shift = shift - IMAGE.drawn_too_far / IMAGE.supersampled
    counts = np.isfinite(to_edge) & np.isfinite(shift) & ~(hidden & (to_edge < shift))
    own, edge, toward = nearest_samples(masks, samples, covered, reach=reach)
    back = ((masks.edge_px[edge] - samples.px[own]) * toward).sum(1) - shift[own]
    stack = masks.edge_stack[edge]
    beyond = _is_hidden(masks, stack, masks.edge_px[edge], normals=masks.edge_normals[edge], offsets=offsets)
    keep = np.isfinite(back) & ~(beyond & (back < 0))
    own, toward, back = own[keep], toward[keep], back[keep]
    forth = samples.select(counts)
    reverse = samples.select(own)
    both = OutlineSamples.concatenate((forth, reverse))
    normals = np.concatenate([forth.normals, toward])
    return Distances(
        stack=both.stack,
        px=np.concatenate([(to_edge - shift)[counts], back]),
        place=both.place,
        gradient=_gradients(masks.px_from_world[both.stack], both, normals),
        weight=np.concatenate([np.ones(len(forth.px)), np.full(len(reverse.px), OUTLINE.reverse_weight)]),
        grid=grid,
        leaf=masks.leaf[both.stack],
        num_leaves=len(coefficients),
    )


def _gradients(px_from_world: Floats, samples: OutlineSamples, normals: Floats) -> Floats:
    rows = px_from_world[:, :2, :3] - samples.px[:, :, None] * px_from_world[:, 2:, :3]
    return np.asarray(normals[:, :1] * rows[:, 0] + normals[:, 1:] * rows[:, 1]) / samples.depth[:, None]


def search_edges(
    masks: MaskStack, samples: OutlineSamples, blurred: NDArray[np.float32], *, reach: float, offsets: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Signed distance (K,) along the normals to the nearest edge from inside to outside, NaN for none in reach. Also,
    is the leaf hidden beyond that edge?"""
    steps = np.linspace(-reach, reach, 2 * int(np.ceil(reach)) + 1)
    middle = len(steps) // 2
    near = steps[max(middle - OUTLINE.near_steps, 0) : middle + OUTLINE.near_steps + 1]
    distance = _nearest_edges(masks, samples, blurred, steps=near)
    missed = np.flatnonzero(np.isinf(distance))  # a nearer edge is not to be had farther away
    distance[missed] = _nearest_edges(masks, samples.select(missed), blurred, steps=steps)
    edge = samples.px + np.where(np.isfinite(distance), distance, 0)[:, None] * samples.normals
    hidden = _is_hidden(masks, samples.stack, edge, normals=samples.normals, offsets=offsets)
    return np.where(np.isfinite(distance), distance, np.nan), hidden


def _nearest_edges(masks: MaskStack, samples: OutlineSamples, blurred: NDArray[np.float32], *, steps: Floats) -> Floats:
    """Signed distance (K,) to the nearest edge out of the mask among evenly spaced `steps`; infinite for none."""
    px = np.empty((2, len(samples.px), len(steps)))  # all x, then all y: broadcasting over two numbers is slow
    for axis, along in enumerate(px):
        np.multiply(samples.normals[:, axis, None], steps, out=along)
        along += samples.px[:, axis, None]
    values = masks.interpolate(blurred, samples.stack, np.moveaxis(px, 0, 2))
    is_inside = values >= 0.5
    sample, step = np.nonzero(is_inside[:, :-1] & ~is_inside[:, 1:])
    before = values[sample, step]
    place = steps[step] + (steps[1] - steps[0]) * (before - 0.5) / (before - values[sample, step + 1])
    distance = np.full(len(values), np.inf)
    order = np.lexsort((-step, -np.abs(place)))  # the nearest edge is written last; of two that are as near, the first
    distance[sample[order]] = place[order]
    return distance


def _is_hidden(
    masks: MaskStack, stack: NDArray, edge: Floats, *, normals: Floats, offsets: Floats
) -> NDArray[np.bool_]:
    """Does another instance, or the end of the image, begin just beyond these places of an edge?"""
    hidden = np.zeros(len(edge), bool)
    gap = np.maximum(0, -offsets)[stack]
    for step in OUTLINE.beyond_px:
        hidden |= masks.look_up(masks.others, stack, edge + (step + gap)[:, None] * normals) != 0
    return hidden


def nearest_samples(
    masks: MaskStack, samples: OutlineSamples, covered: NDArray[np.uint8], *, reach: float
) -> tuple[NDArray, NDArray, Floats]:
    """Pairs of an outline sample and an edge sample, and the direction (M, 2) that their distance counts along.

    An edge sample takes the nearest outline sample with a similar normal within twice the reach, and its own normal.
    Where the patch stops short of a tip there is none ahead: samples outside the patch and far from its outline pull
    the nearest sample straight towards them.
    """
    edge, own = masks.edge_places, places_of_views(samples.stack, len(masks))
    there = _take(masks.edge_px, edge)
    here = _take(samples.px, own)
    from_edge, from_own = (np.where(at < 0, np.inf, (px**2).sum(2)) for at, px in ((edge, there), (own, here)))
    square = from_edge[:, :, None] - 2 * _products(there, here) + from_own[:, None]
    if not square.size:
        return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
    straight = square.argmin(2)
    is_outside = _take(masks.look_up(covered, masks.edge_stack, masks.edge_px) == 0, edge)
    normals = _take(masks.edge_normals, edge)
    nearest_square = np.take_along_axis(square, straight[:, :, None], 2)[:, :, 0]
    pulls = is_outside & (nearest_square > OUTLINE.pull_from_px**2) & np.isfinite(nearest_square)
    is_other = _products(normals, _take(samples.normals, own)) < OUTLINE.similar
    np.copyto(square, np.inf, where=is_other)
    nearest = np.where(pulls, straight, square.argmin(2))
    found = pulls | (np.take_along_axis(square, nearest[:, :, None], 2)[:, :, 0] < (2 * reach) ** 2)
    view, place = np.nonzero(found)
    ahead = there[view, place] - here[view, straight[view, place]]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    toward = np.where(pulls[view, place][:, None], ahead, normals[view, place])
    return own[view, nearest[view, place]], edge[view, place], toward


def _products(first: Floats, second: Floats) -> Floats:
    """(S, A, B) of vectors (S, A, 2) and (S, B, 2): matrices of other sizes would be multiplied in another order."""
    return np.asarray(first[:, :, None, 0] * second[:, None, :, 0] + first[:, :, None, 1] * second[:, None, :, 1])


def _take(values: NDArray, places: NDArray) -> NDArray:
    """Values (N, ...) at places (S, most); those of -1 mean nothing."""
    return values[places] if len(values) else np.zeros((*places.shape, *values.shape[1:]), values.dtype)
