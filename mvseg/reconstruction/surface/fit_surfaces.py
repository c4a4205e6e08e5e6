"""Leaves as surfaces: spline patches fitted to the outlines of their masks in all views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.errors import InputError, check_arguments
from mvseg.reconstruction.numbers import DOUBTS, FIT, SEARCH
from mvseg.reconstruction.spread_views import spread_directions, spread_views
from mvseg.reconstruction.surface.fit_patch import FIRST_HALF, SECOND_HALF, PatchFit, approach_patch, fit_patch
from mvseg.reconstruction.surface.hull import Hull, carve_hull, look_at
from mvseg.reconstruction.surface.leaf_frame import find_axes, find_middle, find_quarters, turn_matrix, turn_pixels
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, Floats, measure_patch, patch_grid
from mvseg.reconstruction.surface.leaf_surface import LeafSurface, Quality, cell_normals, measure_sizes
from mvseg.reconstruction.surface.mask_errors import MaskErrors, learn_mask_errors
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.reconstruction.surface.orientation import orient_surfaces
from mvseg.reconstruction.surface.patch_image import (
    cover_crops,
    crop_ious,
    draw_patch,
    hiding_pixels,
    project_points,
    view_ious,
)
from mvseg.reconstruction.surface.patch_start import start_patches
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import now_running, progress_bar
from mvseg.system.worker_pool import map_in_order


@check_arguments
def fit_surfaces(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    starts: Mapping[int, LeafSurface] = MappingProxyType({}),
    known: Mapping[int, LeafSurface] = MappingProxyType({}),
    most_views: int | None = None,
    is_rough: bool = False,
) -> dict[int, LeafSurface]:
    """Fit a surface to every instance.

    An instance that more than `most_views` views show is fitted to that many of them, see `spread_views`.
    Inputs may be on any device; the work is done on the CPU, and surfaces are there.

    Args:
        regions: D regions. Those matched to nothing hide leaves as well.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        cameras: V cameras.
        starts: instance id -> a surface that is nearly right; of these instances no start is looked for.
        known: instance id -> a surface that is returned as it is. The others are fitted as if it had been fitted with
            them: it hides what lies behind it, and its `offsets_px` tell how all masks err.
        most_views: at least 2; None: `SEARCH.most_views`.
        is_rough: leave out the second fit, which knows what the leaves hide of each other, and how the masks err, and
            the reasons to doubt a surface.

    Returns:
        {instance id: surface} for every instance. Where no surface can be fitted (one view, masks that agree on no
        point) its coefficients are NaN and its `quality` says why.

    Raises:
        InputError: as many ids as regions are expected; a worker was killed.
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected as many")
    workers = now_running().workers if len(regions) >= SEARCH.few_masks else None
    regions, cameras, instance_ids = regions.to("cpu"), cameras.to("cpu"), instance_ids.cpu()
    frames = instance_frames(regions, instance_ids, cameras)
    stacks: dict[int, MaskStack] = {}
    fits: dict[int, PatchFit] = {}
    surfaces: dict[int, LeafSurface] = {}
    unfitted: dict[int, tuple[MaskStack, Floats | None]] = {}
    for instance in _ids(instance_ids):
        if instance in known:
            continue
        members = regions.select((instance_ids == instance) & (regions.areas > 0))
        views = members.view_index.unique()
        if len(views) < 2:
            surfaces[instance] = LeafSurface.none(views, "seen in one view only")
            continue
        most = most_views or SEARCH.most_views
        members = members.select(torch.isin(members.view_index, views[spread_views(cameras[views], most)]))
        start = starts.get(instance)
        rough = start.coefficients.numpy() if start is not None and start.exists else None
        unfitted[instance] = stack_instance(members, cameras, frames, instance=instance), rough
    answers = map_in_order(partial(_fit_first, is_rough=is_rough), unfitted.values(), workers)
    shown = progress_bar(answers, "fitting surfaces", len(unfitted), unit="instance")
    for instance, (masks, fit) in zip(unfitted, shown, strict=True):
        stacks[instance] = masks
        if fit is None:
            views = torch.from_numpy(unfitted[instance][0].views)
            surfaces[instance] = LeafSurface.none(views, "its masks agree on no point")
        else:
            fits[instance] = fit
    first = dict(fits)
    if not is_rough:
        there: dict[int, PatchFit | LeafSurface] = {**fits, **{n: each for n, each in known.items() if each.exists}}
        ordered = dict(sorted(there.items()))
        offsets = [np.asarray(each.offsets_px) for each in ordered.values()]
        finite = [each[np.isfinite(each)] for each in offsets]
        errors = learn_mask_errors([each for each in finite if len(each) > 1])
        points = {n: patch_grid(*FIT.grid).points(np.asarray(each.coefficients)) for n, each in ordered.items()}
        asked = [(instance, stacks[instance], fit) for instance, fit in first.items()]
        refitted = map_in_order(partial(_fit_again, points, errors), asked, workers)
        for instance, (masks, better) in zip(first, refitted, strict=True):
            stacks[instance], fits[instance] = masks, better
    for instance, fit in fits.items():
        offsets_px = first[instance].offsets_px
        surfaces[instance] = _surface(stacks[instance], fit, offsets=offsets_px, is_judged=not is_rough)
    oriented = orient_surfaces(dict(sorted({**surfaces, **known}.items())), cameras)
    return {**oriented, **known}


def _ids(instance_ids: Tensor) -> list[int]:
    return instance_ids[instance_ids > 0].unique().tolist()


def instance_frames(regions: Regions, instance_ids: Tensor, cameras: Cameras) -> list[np.ndarray]:
    """V frames (H, W) int32: the instance that each pixel shows, higher numbers for unmatched regions, 0 = none."""
    last = int(instance_ids.max()) if len(instance_ids) else 0
    values = torch.where(instance_ids > 0, instance_ids, max(last, 0) + 1 + torch.arange(len(instance_ids)))
    sizes = cameras.sizes.tolist()
    return [regions.label_map(view, values, size).numpy().astype(np.int32) for view, size in enumerate(sizes)]


def _fit_first(asked: tuple[MaskStack, Floats | None], *, is_rough: bool) -> tuple[MaskStack, PatchFit | None]:
    """The first fit of an instance, from a start that is nearly right or from those that are found, and its masks.

    Of several fits the best one, and how far the areas of those that are nearly as good are from its own.
    """
    masks, start = asked
    masks, starts = (masks, [start]) if start is not None else _find_starts(masks, is_rough=is_rough)
    fits = [fit_patch(masks, each, num_steps=SEARCH.first_steps) for each in starts]
    if len(fits) < 2:
        return masks, fits[0] if fits else None
    areas = np.array([measure_sizes(fit.coefficients)[0] for fit in fits])
    scores = np.array([_fine_rank(masks, fit) - _area_cost(fit.coefficients) for fit in fits])
    best = int(scores.argmax())
    weights = np.maximum(0, 1 - (scores[best] - scores) / SEARCH.as_good)
    spread = float(np.sqrt(weights @ (areas / areas[best] - 1) ** 2 / weights.sum()))
    return masks, replace(fits[best], spread=spread)


def _find_starts(masks: MaskStack, *, is_rough: bool) -> tuple[MaskStack, list[Floats]]:
    """The best of several starts, moved to the masks; and the masks that are right.

    Rough fits have one. They tell leaves from what is none, and among many starts masks of two leaves find one, too,
    that seems to explain them: so others than the likeliest are only tried where that ends badly. The first hull asks
    that no view looks past the leaf; where faulty masks make that too strict, the majority counts.
    """
    axes = masks.axes
    masks = masks.turn_world(axes)
    hull = carve_hull(masks)
    seen = hull.points[hull.is_seen] if hull.is_seen.any() else hull.points
    if len(seen):
        is_right = ~find_wrong_masks(masks, seen)
        if not is_right.all():
            masks = masks.select(is_right)
            hull = carve_hull(masks)
    if not len(hull.points):
        return masks.turn_world(axes.T), []
    few = _few_views(masks, hull.points.mean(0))
    found = _Found()
    for keep in (hull.is_seen, np.ones_like(hull.is_seen)):
        if found.is_good:
            break
        likely = _likely_starts(few, replace(hull, voxels=hull.voxels[keep]), is_rough=is_rough)
        for starts in (likely[:1], likely[1:]) if is_rough else (likely,):
            found = found if found.is_good else _try_starts(few, starts, found)
    best = found.likely_best() if is_rough else found.best(SEARCH.most_fits)
    return masks.turn_world(axes.T), [found.patches[index] @ axes for index in best]


def _few_views(masks: MaskStack, middle: Floats) -> MaskStack:
    """At most `SEARCH.searched_views` of the views, evenly spread around the middle of the leaf."""
    matrices, shifts = masks.px_from_world[:, :, :3], masks.px_from_world[:, :, 3:]
    ways = -np.linalg.solve(matrices, shifts)[..., 0] - middle
    chosen = spread_directions(ways / np.linalg.norm(ways, axis=1, keepdims=True), SEARCH.searched_views)
    return masks.select(np.isin(np.arange(len(masks)), chosen))


@dataclass(frozen=True, eq=False)
class _Found:
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


def _try_starts(masks: MaskStack, starts: list[Floats], found: _Found) -> _Found:
    """Starts moved half the way to the masks, and those of them all of the way that may become the best."""
    halves = [approach_patch(masks, start, steps=FIRST_HALF)[0] for start in starts]
    scores = [_rank(masks, patch) - _area_cost(patch) for patch in halves]
    most = max([found.half_way, *scores])
    patches, ends, is_good = list(found.patches), list(found.scores), found.is_good
    for score, half in zip(scores, halves, strict=True):
        if score > most - SEARCH.hopeless:
            patch, offsets = approach_patch(masks, half, steps=SECOND_HALF)
            rank = _rank(masks, patch, offsets)
            explained = max(0.0, rank - _rank(masks, patch))
            is_good |= rank + SEARCH.forgiven * explained > SEARCH.good_iou
            patches.append(patch)
            ends.append(rank - _area_cost(patch))
    return _Found(tuple(patches), tuple(ends), is_good, most)


def _area_cost(coefficients: Floats) -> float:
    """What is taken off the rank of a patch before it is compared with others."""
    return SEARCH.area_cost * float(np.log(measure_sizes(coefficients)[0]))


def _likely_starts(masks: MaskStack, hull: Hull, *, is_rough: bool) -> list[Floats]:
    """How well a start explains the masks, before any fit, tells how likely it is. For a rough fit the first one is
    enough where it shows clearly how the blade lies."""
    starts = start_in(hull)
    if is_rough and starts and _rank(masks, starts[0]) >= SEARCH.clear_iou:
        return starts[:1]
    ranks = [_rank(masks, start) for start in starts]
    return [starts[index] for index in sorted(range(len(ranks)), key=lambda index: -ranks[index])[:SEARCH.most_starts]]


def start_in(hull: Hull) -> list[Floats]:
    """`start_patches` in whole numbers of voxels: many of these are equally far from each other, and in world units
    rounding, and with it the world's scale, would choose between them."""
    starts = start_patches(hull.voxels.astype(float))
    for start in starts:
        start *= hull.size
        start[MIDRIB] += hull.corner + 0.5 * hull.size
    return starts


def _rank(masks: MaskStack, coefficients: Floats, offsets: Floats | None = None) -> float:
    """Median IoU over the views, coarsely; less for a patch that is wider than long."""
    points = patch_grid(*FIT.far_grid).points(coefficients)
    covered = cover_crops(masks, project_points(masks.px_from_world, points)) > 0
    return float(np.median(crop_ious(masks, covered, offsets=offsets))) - _wide_cost(coefficients)


def _fine_rank(masks: MaskStack, fit: PatchFit) -> float:
    """The same, finely, of the mean IoU: of fits that are nearly as good, medians pick one by chance."""
    points = patch_grid(*FIT.grid).points(fit.coefficients)
    ious = view_ious(masks, points, offsets=np.nan_to_num(fit.offsets_px))
    return float(ious.mean()) - _wide_cost(fit.coefficients)


def _wide_cost(coefficients: Floats) -> float:
    size = measure_patch(coefficients)
    return SEARCH.wide_cost if 2 * size.half_width > size.length else 0.0


def find_wrong_masks(masks: MaskStack, points: Floats) -> NDArray[np.bool_]:
    """(S,) bool: masks that hardly any voxel (P, 3) falls into although nothing hides it there: another leaf's.

    None where fewer than three would be left.
    """
    inside, free = look_at(masks, points)
    shares = inside.sum(1) / np.maximum((inside | free).sum(1), 1)
    is_wrong = shares < SEARCH.wrong_share * np.median(shares)
    return is_wrong if (~is_wrong).sum() >= 3 else np.zeros(len(masks), bool)


def stack_instance(members: Regions, cameras: Cameras, frames: list[np.ndarray], *, instance: int) -> MaskStack:
    """The outlines of one instance, in photos turned to a side of its own; its masks of one view are united."""
    views = members.view_index.unique().tolist()
    united = [members.union((members.view_index == view).nonzero()[:, 0].tolist()) for view in views]
    px_from_world, boxes = cameras.px_from_world[views].numpy(), np.array([crop.box for crop in united])
    middle = find_middle(px_from_world, (boxes[:, :2] + boxes[:, 2:]) / 2)
    axes = find_axes(px_from_world, middle, np.array([int(crop.pixels.sum()) for crop in united]))
    quarters = find_quarters(px_from_world, middle, axes)
    turns = np.array([turn_matrix(each, frames[view].shape[::-1]) for each, view in zip(quarters, views, strict=True)])
    ends = turns[:, :2, :2] @ boxes.reshape(-1, 2, 2).transpose(0, 2, 1) + turns[:, :2, 2:]
    return stack_masks(
        [turn_pixels(crop.pixels.numpy(), each) for crop, each in zip(united, quarters, strict=True)],
        [turn_pixels(frames[view], each) for view, each in zip(views, quarters, strict=True)],
        views,
        px_from_world=turns @ px_from_world,
        mask_corners=[(round(x), round(y)) for x, y in ends.min(2).tolist()],
        own=instance,
        axes=axes,
    )


def _fit_again(
    points: Mapping[int, Floats], errors: MaskErrors | None, asked: tuple[int, MaskStack, PatchFit]
) -> tuple[MaskStack, PatchFit]:
    """A leaf fitted to what is its rim, now that all leaves (`points` of their grids) and the errors of the masks are
    known."""
    instance, masks, fit = asked
    margin = SEARCH.behind * measure_patch(fit.coefficients).length
    others = {other: grid for other, grid in points.items() if other != instance}
    hiding = hiding_pixels(masks, points[instance], others, margin=margin)
    masks = replace(masks, others=hiding)
    return masks, replace(fit_patch(masks, fit.coefficients, num_steps=FIT.num_steps, errors=errors), spread=fit.spread)


def _surface(masks: MaskStack, fit: PatchFit, *, offsets: Floats, is_judged: bool) -> LeafSurface:
    """What a fit found; `offsets` (S,) are those of the first one."""
    if not np.isfinite(fit.covariance).all():
        return LeafSurface.none(torch.from_numpy(masks.views), "its masks do not tell its shape")
    points = patch_grid(*FIT.grid).points(fit.coefficients)
    grown = np.nan_to_num(fit.offsets_px)
    drawn = draw_patch(masks, project_points(masks.px_from_world, points), offsets=grown, is_blurred=False) >= 0.5
    iou, inside = crop_ious(masks, drawn), masks.inside.sum((1, 2))
    lacking = float(((masks.inside & ~drawn).sum((1, 2)) / np.median(inside)).max())
    surface = LeafSurface(
        coefficients=torch.from_numpy(fit.coefficients),
        covariance=torch.from_numpy(fit.covariance),
        views=torch.from_numpy(masks.views),
        residual_px=torch.from_numpy(fit.residual_px * masks.pixel_size),
        iou=torch.from_numpy(iou),
        is_oriented=False,
        quality=Quality(),
        offsets_px=torch.from_numpy(offsets),
    )
    # Where other fits are as good, all deviations are larger by as much as that of the area is.
    wider = 1 + (fit.spread * surface.area / surface.deviations[0]) ** 2
    surface = replace(surface, covariance=wider * surface.covariance)
    if not is_judged:
        return surface
    return replace(surface, quality=Quality((*_judge(surface, lacking), *_judge_shape(masks, points))))


def _judge_shape(masks: MaskStack, points: Floats) -> list[str]:
    """The reasons why a shape may be none that a patch can have; `points` (rows, columns, 3) of its grid."""
    reasons, areas = [], np.linalg.norm(cell_normals(points), axis=-1).ravel()
    centres = (points[1:, 1:] + points[1:, :-1] + points[:-1, 1:] + points[:-1, :-1]) / 4
    px = project_points(masks.px_from_world, centres).px.reshape(-1, 2)
    stack = np.arange(len(masks)).repeat(len(areas))
    is_open = (masks.look_up(masks.others, stack, px) == 0).reshape(len(masks), -1)
    is_inside = masks.look_up(masks.inside, stack, px).reshape(len(masks), -1)
    shown = (is_inside & is_open).sum(0) / np.maximum(is_open.sum(0), 1)
    unshown = float(areas[shown < DOUBTS.shown].sum() / areas.sum())
    if unshown > DOUBTS.most_unshown:
        reasons.append(f"{100 * unshown:.0f} % of the surface is in hardly any mask: the leaf has lobes or holes")
    along = np.linalg.norm(np.diff(points[:, points.shape[1] // 2], axis=0), axis=-1).cumsum()
    widths = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1)
    places = np.append(0, along) / along[-1]
    ends = np.interp((DOUBTS.near_end, 1 - DOUBTS.near_end), places, widths) / widths.max()
    if ends.max() > DOUBTS.blunt:
        reasons.append("one end is blunt: where the midrib ends, and so the length, is a guess")
    return reasons


def _judge(surface: LeafSurface, lacking: float) -> list[str]:
    """The reasons to doubt a fit; what it lacks of one of its masks is `lacking`, as a share of the median mask."""
    reasons = []
    if not surface.is_credible:
        reasons.append("no leaf, or its masks contradict each other: no single blade explains them")
    if len(surface.views) == 2:
        reasons.append("seen in two views only")
    iou = float(surface.iou.median())
    if iou < DOUBTS.least_iou:
        reasons.append(f"the surface explains its masks badly (median IoU {iou:.2f})")
    if iou > DOUBTS.clean_iou and lacking > DOUBTS.most_lacking:
        reasons.append(f"one view shows more than its surface, by {100 * lacking:.0f} % of a mask")
    share = surface.deviations[0] / surface.area
    if share > DOUBTS.most_area_share:
        reasons.append(f"its area is uncertain by {100 * share:.0f} %")
    return reasons
