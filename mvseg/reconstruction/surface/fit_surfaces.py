"""Leaves as surfaces: spline patches fitted to the outlines of their masks in all views."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.fit_patch import FIT_GRID, NUM_STEPS, NUM_WARM_STEPS, PatchFit, fit_patch
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, Floats, measure_patch, patch_grid
from mvseg.reconstruction.surface.leaf_surface import LeafSurface, Quality, measure_sizes
from mvseg.reconstruction.surface.mask_errors import MaskErrors, learn_mask_errors
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.reconstruction.surface.orientation import orient_surfaces
from mvseg.reconstruction.surface.patch_image import hiding_pixels, project_points, view_ious
from mvseg.reconstruction.surface.patch_start import start_patches
from mvseg.reconstruction.voxels import VoxelGrid, back_project
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.worker_pool import spread

HULL = ReconstructConfig(voxel_budget=25_000)
HULL_BY_VOTE = ReconstructConfig(voxel_budget=25_000, seen_share=0.0)  # where faulty masks leave nothing of the first
GOOD_IOU = 0.9  # of a fit after which no less likely start is tried
LEAST_GAIN = 0.03  # in IoU, for another start to be better
AREA_COST = 0.1  # in IoU, of a surface e times as large: bulges can hide behind the outlines of a level leaf
CLEAR_IOU = 0.75  # of a start that shows how the blade lies
WIDE_COST = 0.1  # in IoU, of a start that is wider than long
UNCLEAR, MOST_FITS = 0.05, 3  # starts that are worse by less than this are tried as well, and so many at most
WRONG_SHARE = 0.25  # of the median share of voxels in a mask: with less of them it is another leaf's
MOST_WRONG = 0.34  # of a leaf's masks
BEHIND = 0.03  # of the leaf's length: a neighbour that is farther away by this lies behind

# What a surface must reach not to be doubted.
LEAST_IOU, MOST_AREA_SHARE = 0.8, 0.1

FEW_MASKS = 60  # that one process fits sooner than others start
MOST_VIEWS = 20  # of an instance that its fit looks at; more add time, and next to nothing else


def fit_surfaces(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    starts: Mapping[int, LeafSurface] = MappingProxyType({}),
    known: Mapping[int, LeafSurface] = MappingProxyType({}),
    most_views: int = MOST_VIEWS,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> dict[int, LeafSurface]:
    """Fit a surface to every instance.

    An instance that more than `most_views` views show is fitted to that many of them, spread evenly over their order.

    Args:
        regions: D regions. Those matched to nothing hide leaves as well.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        cameras: V cameras.
        starts: instance id -> a surface that is nearly right; of these instances no start is looked for.
        known: instance id -> a surface that is returned as it is. The others are fitted as if it had been fitted with
            them: it hides what lies behind it, and its masks tell how all masks err.
        most_views: at least 2.
        workers: processes that instances are spread over, see `start_workers`; None: this one does it all.
        progress: show a progress bar over the instances.

    Returns:
        {instance id: surface} for every instance. Where no surface can be fitted (one view, masks that agree on no
        point) its coefficients are NaN and its `quality` says why.

    Raises:
        InputError: as many ids as regions are expected; a worker was killed.
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected as many")
    workers = workers if len(regions) >= FEW_MASKS else None
    regions, cameras, instance_ids = regions.to("cpu"), cameras.to("cpu"), instance_ids.cpu()
    frames = _instance_frames(regions, instance_ids, cameras)
    stacks: dict[int, MaskStack] = {}
    fits: dict[int, PatchFit] = {}
    surfaces: dict[int, LeafSurface] = {}
    unfitted: dict[int, _Unfitted] = {}
    for instance in _ids(instance_ids):
        members = regions.select((instance_ids == instance) & (regions.areas > 0))
        views = members.view_index.unique()
        if instance in known and not known[instance].exists:
            continue
        if len(views) < 2:
            surfaces[instance] = LeafSurface.none(views, "seen in one view only")
            continue
        kept = known[instance].views if instance in known else spread_views(views, most_views)
        members = members.select(torch.isin(members.view_index, kept))
        stacks[instance] = _stack(members, cameras, frames, instance=instance)
        if instance in known:
            fits[instance] = fit_patch(stacks[instance], known[instance].coefficients.numpy(), num_steps=0)
            continue
        start = starts.get(instance)
        unfitted[instance] = _Unfitted(
            masks=stacks[instance],
            members=members,
            start=start.coefficients.numpy() if start is not None and start.exists else None,
            good_iou=GOOD_IOU if len(kept) == len(views) else LEAST_IOU,
        )
    asked = ((leaf, _pack_free(frames, leaf.members)) for leaf in unfitted.values())
    answers = spread(partial(_fit_first, cameras), asked, workers)
    shown = tqdm(answers, "surfaces", len(unfitted), unit="instance", disable=not progress)
    for instance, (masks, fit) in zip(unfitted, shown, strict=True):
        stacks[instance] = masks
        if fit is None:
            surfaces[instance] = LeafSurface.none(
                unfitted[instance].members.view_index.unique(), "its masks agree on no point"
            )
        else:
            fits[instance] = fit
    fits = {instance: fits[instance] for instance in stacks if instance in fits}
    offsets = [fit.offsets_px[np.isfinite(fit.offsets_px)] for fit in fits.values()]
    errors = learn_mask_errors([each for each in offsets if len(each) > 1])
    first, fits = fits, {}
    points = {instance: patch_grid(*FIT_GRID).points(fit.coefficients) for instance, fit in first.items()}
    again = [instance for instance in first if instance not in known]
    refitted = spread(partial(_fit_again, points, errors), ((i, stacks[i], first[i]) for i in again), workers)
    for instance, (masks, better) in zip(again, refitted, strict=True):
        stacks[instance], fits[instance] = masks, better
    surfaces |= {instance: _surface(stacks[instance], fit) for instance, fit in fits.items()}
    oriented = orient_surfaces(dict(sorted({**surfaces, **known}.items())), cameras)
    return {**oriented, **known}


def _ids(instance_ids: Tensor) -> list[int]:
    return instance_ids[instance_ids > 0].unique().tolist()


def spread_views(views: Tensor, most: int) -> Tensor:
    """At most so many of the views (S,), the first one and others at even distances in their order."""
    if len(views) <= most:
        return views
    return views[torch.arange(most) * len(views) // most]


def _instance_frames(regions: Regions, instance_ids: Tensor, cameras: Cameras) -> list[np.ndarray]:
    """V frames (H, W) int32: the instance that each pixel shows, higher numbers for unmatched regions, 0 = none."""
    last = int(instance_ids.max()) if len(instance_ids) else 0
    values = torch.where(instance_ids > 0, instance_ids, max(last, 0) + 1 + torch.arange(len(instance_ids)))
    sizes = cameras.sizes.tolist()
    return [regions.label_map(view, values, size).numpy().astype(np.int32) for view, size in enumerate(sizes)]


@dataclass(frozen=True, eq=False)
class _Unfitted:
    """An instance without a surface: its outlines, its masks, a start that is nearly right, and the IoU of a fit after
    which no other start is tried."""

    masks: MaskStack
    members: Regions
    start: Floats | None
    good_iou: float


def _pack_free(frames: list[np.ndarray], members: Regions) -> dict[int, NDArray[np.uint8]]:
    """Where the views of the members show no instance at all, eight pixels in a byte; row by row."""
    return {view: np.packbits(frames[view] == 0, axis=1) for view in members.view_index.unique().tolist()}


def _fit_first(
    cameras: Cameras, asked: tuple[_Unfitted, Mapping[int, NDArray[np.uint8]]]
) -> tuple[MaskStack, PatchFit | None]:
    """The first fit of an instance, and the masks it is to."""
    leaf, packed = asked
    if leaf.start is not None:
        return leaf.masks, fit_patch(leaf.masks, leaf.start, num_steps=NUM_WARM_STEPS)
    widths = cameras.sizes[:, 0].tolist()
    free = {
        view: torch.from_numpy(np.unpackbits(bits, axis=1, count=widths[view])).bool() for view, bits in packed.items()
    }
    return _fit_from_hull(leaf.masks, leaf.members, cameras, free=free, good_iou=leaf.good_iou)


def _fit_from_hull(
    masks: MaskStack, members: Regions, cameras: Cameras, *, free: Mapping[int, Tensor], good_iou: float
) -> tuple[MaskStack, PatchFit | None]:
    """The best of the fits from several starts, which are tried until one explains the masks; and the masks it is to.

    The first hull asks that no view looks past the leaf; where faulty masks make that too strict, the majority counts.
    Very many views leave a hull that shows how the blade lies: there a lower IoU is good.
    """
    best, best_score, is_good, is_checked = None, -np.inf, False, False
    for config in (HULL, HULL_BY_VOTE):
        hull = back_project(members, cameras, config=config, free=free)
        if hull is None or not hull.occupied.any():
            continue
        if not is_checked:
            is_checked, is_right = True, ~find_wrong_masks(masks, hull.points.numpy())
            if not is_right.all():
                masks = masks.select(is_right)
                members = members.select(torch.isin(members.view_index, torch.from_numpy(masks.views)))
                hull = back_project(members, cameras, config=HULL, free=free) or hull
        starts, ranks = _likely_starts(masks, hull)
        for start, rank in zip(starts, ranks, strict=True):
            if is_good and rank < ranks[0] - UNCLEAR:
                break
            fit = fit_patch(masks, start, num_steps=NUM_STEPS)
            iou = _median_iou(masks, fit.coefficients, offsets=np.nan_to_num(fit.offsets_px))
            score = iou - AREA_COST * np.log(measure_sizes(fit.coefficients)[0])
            if score > best_score + LEAST_GAIN:
                best, best_score, is_good = fit, score, iou > good_iou
        if is_good:
            break
    return masks, best


def _likely_starts(masks: MaskStack, hull: VoxelGrid) -> tuple[list[Floats], list[float]]:
    """At most MOST_FITS starts from the voxels of the hull, the likeliest first, and how likely each is.

    They are told by how well they explain the masks as they are, before any fit.
    """
    starts = start_in(hull)
    ranks = [_rank(masks, start) for start in starts]
    if ranks and max(ranks) < CLEAR_IOU:
        starts = start_in(hull, is_clear=False)
        ranks = [_rank(masks, start) for start in starts]
    order = sorted(range(len(starts)), key=lambda index: -ranks[index])[:MOST_FITS]
    return [starts[index] for index in order], [ranks[index] for index in order]


def start_in(hull: VoxelGrid, *, is_clear: bool = True) -> list[Floats]:
    """`start_patches` in whole numbers of voxels: many of these are equally far from each other, and in world units
    rounding, and with it the world's scale, would choose between them."""
    corner = (hull.origin + 0.5 * hull.voxel_size).numpy()
    starts = start_patches(hull.occupied.nonzero().double().numpy(), is_clear=is_clear)
    starts = [hull.voxel_size * start for start in starts]
    for start in starts:
        start[MIDRIB] += corner
    return starts


def _rank(masks: MaskStack, start: Floats) -> float:
    size = measure_patch(start)
    return _median_iou(masks, start) - (WIDE_COST if 2 * size.half_width > size.length else 0.0)


def _median_iou(masks: MaskStack, coefficients: Floats, *, offsets: Floats | None = None) -> float:
    return float(np.median(view_ious(masks, patch_grid(*FIT_GRID).points(coefficients), offsets=offsets)))


def find_wrong_masks(masks: MaskStack, points: Floats) -> NDArray[np.bool_]:
    """(S,) bool: masks that hardly any voxel (P, 3) falls into although nothing hides it there: another leaf's.

    None where they are more than MOST_WRONG of all, or where fewer than three would be left.
    """
    seen = project_points(masks.px_from_world, points[None]).px.reshape(-1, 2)
    stack = np.repeat(np.arange(len(masks)), len(points))
    inside = masks.look_up(masks.inside, stack, seen).reshape(len(masks), -1)
    hidden = masks.look_up(masks.others, stack, seen).reshape(len(masks), -1) != 0
    shares = inside.sum(1) / np.maximum((inside | ~hidden).sum(1), 1)
    is_wrong = shares < WRONG_SHARE * np.median(shares)
    is_much = is_wrong.sum() > MOST_WRONG * len(masks) or (~is_wrong).sum() < 3
    return np.zeros(len(masks), bool) if is_much else is_wrong


def _stack(members: Regions, cameras: Cameras, frames: list[np.ndarray], *, instance: int) -> MaskStack:
    """The outlines of one instance; its masks of one view are united."""
    views = members.view_index.unique().tolist()
    united = [members.union((members.view_index == view).nonzero()[:, 0].tolist()) for view in views]
    return stack_masks(
        [mask.numpy() for _, mask in united],
        [frames[view] for view in views],
        views,
        px_from_world=cameras.px_from_world[views].numpy(),
        mask_corners=[box[:2] for box, _ in united],
        own=instance,
    )


def _fit_again(
    points: Mapping[int, Floats], errors: MaskErrors | None, asked: tuple[int, MaskStack, PatchFit]
) -> tuple[MaskStack, PatchFit]:
    """A leaf fitted to what is its rim, now that all leaves (`points` of their grids) and the errors of the masks are
    known."""
    instance, masks, fit = asked
    margin = BEHIND * measure_patch(fit.coefficients).length
    others = {other: grid for other, grid in points.items() if other != instance}
    hiding = hiding_pixels(masks, points[instance], others, margin=margin)
    if errors or (hiding != masks.others).any():
        masks = masks.with_others(hiding)
        fit = fit_patch(masks, fit.coefficients, num_steps=NUM_WARM_STEPS, errors=errors)
    return masks, fit


def _surface(masks: MaskStack, fit: PatchFit) -> LeafSurface:
    if not np.isfinite(fit.covariance).all():
        return LeafSurface.none(torch.from_numpy(masks.views), "its masks do not tell its shape")
    points = patch_grid(*FIT_GRID).points(fit.coefficients)
    iou = view_ious(masks, points, offsets=np.nan_to_num(fit.offsets_px))
    surface = LeafSurface(
        coefficients=torch.from_numpy(fit.coefficients),
        covariance=torch.from_numpy(fit.covariance),
        views=torch.from_numpy(masks.views),
        residual_px=torch.from_numpy(fit.residual_px),
        iou=torch.from_numpy(iou),
        is_oriented=False,
        quality=Quality(),
    )
    return replace(surface, quality=_judge(surface))


def _judge(surface: LeafSurface) -> Quality:
    """The reasons to doubt a fit."""
    reasons = []
    if not surface.is_credible:
        reasons.append("no leaf, or its masks contradict each other: no single blade explains them")
    if len(surface.views) == 2:
        reasons.append("seen in two views only")
    iou = float(surface.iou.median())
    if iou < LEAST_IOU:
        reasons.append(f"the surface explains its masks badly (median IoU {iou:.2f})")
    share = surface.deviations[0] / surface.area
    if share > MOST_AREA_SHARE:
        reasons.append(f"its area is uncertain by {100 * share:.0f} %")
    return Quality(tuple(reasons))
