"""Starts of the fit of each leaf: patches through the hulls of its masks, moved to the masks, the best of them.

Leaves are searched side by side: the outlines of all of their patches are compared with the masks in one call.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import FIT, SEARCH
from mvseg.reconstruction.spread_views import spread_directions
from mvseg.reconstruction.surface.fit_patch import FIRST_HALF, SECOND_HALF, approach_patches
from mvseg.reconstruction.surface.hull import Hull, carve_hull, locate_points
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, measure_patch, patch_grid
from mvseg.reconstruction.surface.leaf_surface import measure_sizes
from mvseg.reconstruction.surface.mask_stack import MaskStack, join_stacks
from mvseg.reconstruction.surface.patch_image import cover_crops, crop_ious, project_points
from mvseg.reconstruction.surface.patch_start import start_patches


def find_starts(stacks: Sequence[MaskStack], *, is_rough: bool) -> list[tuple[MaskStack, list[Floats]]]:
    """The best of several starts of each leaf, moved to its masks; and the masks that are right.

    Rough fits, which tell leaves from others, have one: among many starts, masks of two leaves find one, too, that
    seems to explain them. So others than the likeliest are only tried where that ends badly. The first hull asks that
    no view looks past the leaf; where faulty masks make that too strict, the majority counts.
    """
    turned = [_carve(masks.turn_world(masks.axes)) for masks in stacks]
    few = [_few_views(masks, hull.points.mean(0)) if len(hull.points) else masks for masks, hull in turned]
    ranked = dict.fromkeys(range(len(stacks)), _MovedStarts())
    for is_strict in (True, False):
        searched = [index for index, (_, hull) in enumerate(turned) if len(hull.points) and not ranked[index].is_good]
        likely = {}
        for index in searched:
            hull = turned[index][1]
            seen = replace(hull, voxels=hull.voxels[hull.is_seen]) if is_strict else hull
            likely[index] = _likely_starts(few[index], seen, is_rough=is_rough)
        for part in (slice(1), slice(1, None)) if is_rough else (slice(None),):
            tried = {index: starts[part] for index, starts in likely.items() if not ranked[index].is_good}
            ranked |= _try_starts({index: starts for index, starts in tried.items() if starts}, few, ranked)
    answers = []
    for (masks, _), stack, each in zip(turned, stacks, ranked.values(), strict=True):
        best = each.likely_best() if is_rough else each.best(SEARCH.most_fits)
        answers.append((masks.turn_world(stack.axes.T), [each.patches[index] @ stack.axes for index in best]))
    return answers


def _carve(masks: MaskStack) -> tuple[MaskStack, Hull]:
    hull = carve_hull(masks)
    seen = hull.points[hull.is_seen] if hull.is_seen.any() else hull.points
    if len(seen):
        is_right = ~find_wrong_masks(masks, seen)
        if not is_right.all():
            masks = masks.select(is_right)
            hull = carve_hull(masks)
    return masks, hull


def _few_views(masks: MaskStack, middle: Floats) -> MaskStack:
    matrices, shifts = masks.px_from_world[:, :, :3], masks.px_from_world[:, :, 3:]
    ways = -np.linalg.solve(matrices, shifts)[..., 0] - middle
    chosen = spread_directions(ways / np.linalg.norm(ways, axis=1, keepdims=True), SEARCH.searched_views)
    return masks.select(np.isin(np.arange(len(masks)), chosen))


@dataclass(frozen=True, eq=False)
class _MovedStarts:
    """Patches that were moved to the masks, with their scores; does one explain the masks; the best score half way."""

    patches: tuple[Floats, ...] = ()
    scores: tuple[float, ...] = ()
    is_good: bool = False
    half_way: float = -np.inf

    def best(self, most: int) -> list[int]:
        """Indices of the patches, the one with the best score first."""
        return sorted(range(len(self.patches)), key=lambda index: -self.scores[index])[:most]

    def likely_best(self) -> list[int]:
        """Index of the likeliest patch that none after it beats clearly; nothing without a patch."""
        best: list[int] = []
        for index, score in enumerate(self.scores):
            if not best or score > self.scores[best[0]] + SEARCH.least_gain:
                best = [index]
        return best


def _try_starts(
    tried: Mapping[int, list[Floats]], few: Sequence[MaskStack], best: Mapping[int, _MovedStarts]
) -> dict[int, _MovedStarts]:
    """Move the starts of these leaves half the way to the masks, and those that may become the best all the way."""
    if not tried:
        return {}
    leaf = np.repeat(list(tried), [len(starts) for starts in tried.values()])
    halves = np.concatenate(list(tried.values()))
    stacks = [few[index] for index in leaf]
    halves, _ = approach_patches(join_stacks(stacks), halves, steps=FIRST_HALF)
    scores = _ranks(stacks, halves) - _area_costs(halves)
    most = {index: max(best[index].half_way, scores[leaf == index].max()) for index in tried}
    goes_on = scores > np.array([most[index] for index in leaf]) - SEARCH.hopeless
    patches, ends, is_good = halves[goes_on], scores[goes_on], goes_on[goes_on]
    if goes_on.any():
        stacks = [few[index] for index in leaf[goes_on]]
        masks = join_stacks(stacks)
        patches, offsets = approach_patches(masks, patches, steps=SECOND_HALF)
        ranks = _ranks(stacks, patches, masks.split(offsets))
        explained = np.maximum(0.0, ranks - _ranks(stacks, patches))
        ends, is_good = ranks - _area_costs(patches), ranks + SEARCH.forgiven * explained > SEARCH.good_iou
    answers = {}
    for index in tried:
        before, own = best[index], leaf[goes_on] == index
        answers[index] = _MovedStarts(
            patches=(*before.patches, *patches[own]),
            scores=(*before.scores, *ends[own].tolist()),
            is_good=before.is_good or bool(is_good[own].any()),
            half_way=most[index],
        )
    return answers


def area_cost(coefficients: Floats) -> float:
    """Cost of its area that lowers the rank of a patch."""
    return SEARCH.area_cost * float(np.log(measure_sizes(coefficients)[0]))


def _area_costs(patches: Floats) -> Floats:
    return np.array([area_cost(patch) for patch in patches])


def wide_cost(coefficients: Floats) -> Floats:
    """Cost for the rank of a patch, or of several (..., 26, 3), that is wider than long."""
    size = measure_patch(coefficients)
    return np.where(2 * size.half_width > size.length, SEARCH.wide_cost, 0.0)


def _likely_starts(masks: MaskStack, hull: Hull, *, is_rough: bool) -> list[Floats]:
    """Sort the starts by how well they explain the masks; for a rough fit, a clear first one is enough."""
    starts, ranks = start_in(hull), []
    for start in starts:
        ranks.append(float(_ranks([masks], start[None])[0]))
        if is_rough and ranks[0] >= SEARCH.clear_iou:
            return [start]
    return [starts[index] for index in sorted(range(len(ranks)), key=lambda index: -ranks[index])[: SEARCH.most_starts]]


def start_in(hull: Hull) -> list[Floats]:
    """`start_patches` in whole numbers of voxels: many are equally far, and in world units rounding would choose."""
    starts = start_patches(hull.voxels.astype(float))
    for start in starts:
        start *= hull.size
        start[MIDRIB] += hull.corner + 0.5 * hull.size
    return starts


def _ranks(stacks: Sequence[MaskStack], patches: Floats, offsets: Sequence[Floats] | None = None) -> Floats:
    """(L,) median IoU of patches (L, 26, 3) over the views of each leaf, coarsely; less for one wider than long."""
    ious, points = [], patch_grid(*FIT.far_grid).points(patches)
    for index, masks in enumerate(stacks):
        covered = cover_crops(masks, project_points(masks.px_from_world, points[index])) > 0
        off = None if offsets is None else offsets[index]
        ious.append(np.median(crop_ious(masks, covered, offsets=off)))
    return np.array(ious) - wide_cost(patches)


def find_wrong_masks(masks: MaskStack, points: Floats) -> NDArray[np.bool_]:
    """(S,) bool: masks that hardly any voxel (P, 3) falls into although nothing hides it there: another leaf's. None
    where fewer than three others remain."""
    inside, free = locate_points(masks, points)
    shares = inside.sum(1) / np.maximum((inside | free).sum(1), 1)
    is_wrong = shares < SEARCH.wrong_share * np.median(shares)
    return is_wrong if (~is_wrong).sum() >= 3 else np.zeros(len(masks), bool)
