"""Leaves as surfaces: spline patches fitted to the outlines of their masks in all views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.errors import InputError, check_arguments
from mvseg.reconstruction.numbers import DOUBTS, FIT, SEARCH
from mvseg.reconstruction.spread_views import spread_views
from mvseg.reconstruction.surface.find_starts import area_cost, find_starts, wide_cost
from mvseg.reconstruction.surface.fit_patch import PatchFit, fit_patches
from mvseg.reconstruction.surface.leaf_frame import find_axes, find_middle, find_quarters, turn_matrix, turn_pixels
from mvseg.reconstruction.surface.leaf_patch import measure_patch, patch_grid
from mvseg.reconstruction.surface.leaf_surface import ByInstance, LeafSurface, measure_sizes
from mvseg.reconstruction.surface.mask_errors import MaskErrors, learn_mask_errors
from mvseg.reconstruction.surface.mask_stack import MaskStack, join_stacks, stack_masks
from mvseg.reconstruction.surface.occupancy import occupy_surface, unshown_share
from mvseg.reconstruction.surface.orientation import orient_surfaces
from mvseg.reconstruction.surface.patch_image import (
    hiding_pixels,
    select_hiding,
    view_ious,
)
from mvseg.reconstruction.surface.surface_cache import Approach, Cache, name_first, name_second, reuse_object
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import now_running, progress_bar
from mvseg.system.threads import on_one_thread
from mvseg.system.worker_pool import Workers, map_in_order


@check_arguments
@on_one_thread()
def fit_surfaces(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    starts: Mapping[int, LeafSurface] = MappingProxyType({}),
    same_segmenter: Mapping[int, LeafSurface] | None = None,
    most_views: int | None = None,
    is_rough: bool = False,
    cache: Cache | None = None,
) -> dict[int, LeafSurface]:
    """Fit a surface to every instance.

    An instance that more than `most_views` views show is fitted to that many of them, see `spread_views`. Inputs may be
    on any device; the work is done on the CPU, and surfaces are there.

    Args:
        regions: D regions. Those matched to nothing hide leaves as well.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        starts: instance id -> a surface that is nearly right; no start is looked for.
        same_segmenter: surfaces whose `offsets_px` tell how the masks err; None: those that are fitted here. With those
            of a scene before edits, an edit of one leaf does not move all others a little.
        most_views: at least 2; None: `SEARCH.most_views`.
        is_rough: leave out the second fit, which knows what the leaves hide of each other, and how the masks err, and
            the reasons to doubt a surface.
        cache: fits of earlier calls are taken from it, and new ones added; no surface differs by it in any bit.

    Returns:
        {instance id: surface} for every instance. Where no surface can be fitted (one view, masks that agree on no
        point) its coefficients are NaN and its `reasons` say why.

    Raises:
        InputError: as many ids as regions are expected; a worker was killed.
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected as many")
    cache = {} if cache is None else cache
    workers = now_running().workers if len(regions) >= SEARCH.few_masks else ()
    regions, cameras, instance_ids = regions.to("cpu"), cameras.to("cpu"), instance_ids.cpu()
    frames = instance_frames(regions, instance_ids, cameras)
    surfaces: dict[int, LeafSurface] = {}
    asked: dict[int, _Asked] = {}
    for instance in instance_ids[instance_ids > 0].unique().tolist():
        members = regions.select((instance_ids == instance) & (regions.areas > 0))
        views = members.view_index.unique()
        if len(views) < 2:
            surfaces[instance] = LeafSurface.none(views, "one_view", "seen in one view only")
            continue
        most = most_views or SEARCH.most_views
        members = members.select(torch.isin(members.view_index, views[spread_views(cameras[views], most)]))
        start = starts.get(instance)
        rough = start.coefficients.numpy() if start is not None and start.exists else None
        masks = stack_instance(members, cameras, frames, instance=instance)
        asked[instance] = _Asked(name_first(masks, rough), masks, rough)
    first = {each.name: each for each in asked.values()}
    if is_rough:
        names = {instance: f"rough {each.name}" for instance, each in asked.items()}
        _fit_new(cache, {f"rough {name}": each for name, each in first.items()}, _fit_roughly, workers)
    else:
        _fit_new(cache, first, _fit_first, workers)
        again = _ask_again(asked, cache, same_segmenter)
        names = {instance: each.name for instance, each in again.items()}
        _fit_new(cache, {each.name: each for each in again.values()}, _fit_again, workers)
    for instance, each in asked.items():
        nothing = LeafSurface.none(torch.from_numpy(each.masks.views), "no_common_point", "its masks agree on no point")
        surfaces[instance] = cache.get(names.get(instance, "")) or nothing
    oriented = orient_surfaces(dict(sorted(surfaces.items())), cameras)
    return ByInstance((n, reuse_object(cache, names[n], each) if n in names else each) for n, each in oriented.items())


@dataclass(frozen=True, eq=False)
class _Asked:
    name: str
    masks: MaskStack
    start: Floats | None


@dataclass(frozen=True, eq=False)
class _AskedAgain:
    """A leaf to be fitted again, with the errors of its masks, and the grids (rows, columns, 3) that may hide it."""

    name: str
    masks: MaskStack
    approach: Approach
    errors: MaskErrors | None
    others: Mapping[int, Floats]


def _fit_new(
    cache: Cache,
    asked: Mapping[str, Any],
    fit: Callable[[Sequence[Any]], list[Any]],
    workers: Workers,
) -> None:
    new = {name: each for name, each in asked.items() if name not in cache}
    leaves, rest = [*new.values()], range(0, len(new), SEARCH.at_once)
    answers = chain.from_iterable(map_in_order(fit, (leaves[n : n + SEARCH.at_once] for n in rest), workers))
    name = "refining surfaces" if fit is _fit_again else "fitting surfaces"
    for each, answer in zip(new, progress_bar(answers, name, len(new), unit="instance"), strict=True):
        cache[each] = answer


def _ask_again(
    asked: Mapping[int, _Asked], cache: Cache, same_segmenter: Mapping[int, LeafSurface] | None
) -> dict[int, _AskedAgain]:
    found = {instance: cache[each.name] for instance, each in asked.items()}
    approaches = {instance: each for instance, each in found.items() if each is not None}
    measured: Mapping[int, Approach | LeafSurface] = approaches if same_segmenter is None else same_segmenter
    offsets = [measured[instance].offsets_px.numpy() for instance in sorted(measured)]
    finite = [each[np.isfinite(each)] for each in offsets]
    errors = learn_mask_errors([each for each in finite if len(each) > 1])
    points = {n: patch_grid(*FIT.grid).points(each.coefficients.numpy()) for n, each in approaches.items()}
    again = {}
    for instance, approach in approaches.items():
        masks = asked[instance].masks
        masks = masks.select(np.isin(masks.views, approach.views.numpy()))
        near = select_hiding(masks, points[instance], {n: grid for n, grid in points.items() if n != instance})
        name = name_second(asked[instance].name, masks, approach, near, errors=errors)
        again[instance] = _AskedAgain(name, masks, approach, errors, near)
    return again


def instance_frames(regions: Regions, instance_ids: Tensor, cameras: Cameras) -> list[np.ndarray]:
    """V frames (H, W) int32: the instance that each pixel shows, higher numbers for unmatched regions, 0 = none."""
    last = int(instance_ids.max()) if len(instance_ids) else 0
    values = torch.where(instance_ids > 0, instance_ids, max(last, 0) + 1 + torch.arange(len(instance_ids)))
    sizes = cameras.sizes.tolist()
    return [regions.label_map(view, values, size).numpy().astype(np.int32) for view, size in enumerate(sizes)]


def _fit_roughly(asked: Sequence[_Asked]) -> list[LeafSurface | None]:
    fits = _approach(asked, is_rough=True)
    return [None if fit is None else _surface(masks, fit, offsets=fit.offsets_px) for masks, fit in fits]


def _fit_first(asked: Sequence[_Asked]) -> list[Approach | None]:
    fits: list[Approach | None] = []
    for masks, fit in _approach(asked, is_rough=False):
        fits.append(None)
        if fit is not None:
            views, coefficients, offsets_px = map(torch.from_numpy, (masks.views, fit.coefficients, fit.offsets_px))
            fits[-1] = Approach(views=views, coefficients=coefficients, offsets_px=offsets_px, spread=fit.spread)
    return fits


def _approach(asked: Sequence[_Asked], *, is_rough: bool) -> list[tuple[MaskStack, PatchFit | None]]:
    """The right masks of each leaf, and its best fit, whose spread is that of the areas of nearly equally good fits."""
    searched = iter(find_starts([each.masks for each in asked if each.start is None], is_rough=is_rough))
    given = [next(searched) if each.start is None else (each.masks, [each.start]) for each in asked]
    pairs = [(masks, start) for masks, starts in given for start in starts]
    if not pairs:
        return [(masks, None) for masks, _ in given]
    joined, starts = join_stacks([masks for masks, _ in pairs]), np.array([start for _, start in pairs])
    fits = iter(fit_patches(joined, starts, num_steps=SEARCH.first_steps))
    return [(masks, _best_fit(masks, [next(fits) for _ in starts])) for masks, starts in given]


def _best_fit(masks: MaskStack, fits: list[PatchFit]) -> PatchFit | None:
    if len(fits) < 2:
        return fits[0] if fits else None
    areas = np.array([measure_sizes(fit.coefficients)[0] for fit in fits])
    scores = np.array([_fine_rank(masks, fit) - area_cost(fit.coefficients) for fit in fits])
    best = int(scores.argmax())
    weights = np.maximum(0, 1 - (scores[best] - scores) / SEARCH.as_good)
    spread = float(np.sqrt(weights @ (areas / areas[best] - 1) ** 2 / weights.sum()))
    return replace(fits[best], spread=spread)


def _fine_rank(masks: MaskStack, fit: PatchFit) -> float:
    """Rank as in `find_starts`, but by the mean IoU: among nearly equal fits, medians decide by chance."""
    points = patch_grid(*FIT.grid).points(fit.coefficients)
    ious = view_ious(masks, points, offsets=np.nan_to_num(fit.offsets_px))
    return float(ious.mean() - wide_cost(fit.coefficients))


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


def _fit_again(asked: Sequence[_AskedAgain]) -> list[LeafSurface]:
    surfaces = []
    for each in asked:
        first, coefficients = each.approach, each.approach.coefficients.numpy()
        points, margin = patch_grid(*FIT.grid).points(coefficients), float(measure_patch(coefficients).length)
        hiding = hiding_pixels(each.masks, points, each.others, margin=SEARCH.behind * margin)
        masks = replace(each.masks, others=hiding)
        (fit,) = fit_patches(masks, coefficients[None], num_steps=FIT.num_steps, errors=each.errors)
        fit = replace(fit, spread=first.spread)
        surface = _surface(masks, fit, offsets=first.offsets_px.numpy())
        if surface.exists:
            points = patch_grid(*FIT.grid).points(fit.coefficients)
            unshown = unshown_share(masks, points)
            surface = occupy_surface(surface, each.masks, hidden=masks, unshown=unshown)
            surface = replace(surface, reasons=_judge(surface, unshown) | _judge_ends(points))
        surfaces.append(surface)
    return surfaces


def _surface(masks: MaskStack, fit: PatchFit, *, offsets: Floats) -> LeafSurface:
    if not np.isfinite(fit.covariance).all():
        return LeafSurface.none(torch.from_numpy(masks.views), "shape_unknown", "its masks do not tell its shape")
    points = patch_grid(*FIT.grid).points(fit.coefficients)
    surface = LeafSurface(
        coefficients=torch.from_numpy(fit.coefficients),
        covariance=torch.from_numpy(fit.covariance),
        views=torch.from_numpy(masks.views),
        residual_px=torch.from_numpy(fit.residual_px * masks.pixel_size),
        iou=torch.from_numpy(view_ious(masks, points, offsets=np.nan_to_num(fit.offsets_px))),
        is_oriented=False,
        reasons={},
        offsets_px=torch.from_numpy(offsets),
    )
    # Where other fits are as good, all deviations are larger by as much as that of the area is.
    if fit.spread:
        wider = 1 + (fit.spread * surface.area / surface.deviations[0]) ** 2
        surface = replace(surface, covariance=wider * surface.covariance)
    return surface


def _judge_ends(points: Floats) -> dict[str, str]:
    """The reason to doubt the length of a patch; `points` (rows, columns, 3) of its grid."""
    along = np.linalg.norm(np.diff(points[:, points.shape[1] // 2], axis=0), axis=-1).cumsum()
    widths = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1)
    places = np.append(0, along) / along[-1]
    ends = np.interp((DOUBTS.near_end, 1 - DOUBTS.near_end), places, widths) / widths.max()
    if ends.max() <= DOUBTS.blunt:
        return {}
    return {"blunt_end": "one end is blunt: where the midrib ends, and so the length, is a guess"}


def _judge(surface: LeafSurface, unshown: float) -> dict[str, str]:
    reasons = {}
    if not surface.is_credible:
        reasons["no_blade"] = "no leaf, or its masks contradict each other: no single blade explains them"
    if len(surface.views) == 2:
        reasons["two_views"] = "seen in two views only"
    iou = float(surface.iou.median())
    if iou < DOUBTS.least_iou and surface.occupancy is not None:
        reasons["lobed"] = f"lobes or leaflets beside its sheet (median IoU {iou:.2f}): length and width are guesses"
    elif iou < DOUBTS.least_iou:
        reasons["poor_fit"] = f"the surface explains its masks badly (median IoU {iou:.2f})"
    share = surface.deviations[0] / surface.area
    if share > DOUBTS.most_area_share:
        reasons["uncertain_area"] = f"its area is uncertain by {100 * share:.0f} %"
    if unshown > DOUBTS.most_unshown and surface.occupancy is None:
        reasons["lobed"] = f"{100 * unshown:.0f} % of the surface is in hardly any mask: the leaf has lobes or holes"
    return reasons
