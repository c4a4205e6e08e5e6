"""Cross-view verification: the other views correct the masks that a detector found.

A surface that is fitted to an instance's masks in all views says where each view must show it. That settles what no
photo can by itself: which piece of a leaf is the leaf, which mask is none, and which leaf was missed. Not in the paper.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Set
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputWarning
from mvseg.masks import SURE, Masks, MergedMask, Origin, replace_crops
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import mask_box
from mvseg.scene import Cameras
from mvseg.verification.checked_ids import move_masks
from mvseg.verification.leaf_color import ColorCounts, count_colors, has_leaf_color, leaf_colors
from mvseg.verification.recut import AGREES, Box, Mask, agreement, inside
from mvseg.verification.visible_leaves import VisibleLeaf, visible_leaves

Photos = Callable[[int], NDArray[np.uint8]]
Fit = Callable[[Masks], dict[int, LeafSurface]]

LEAST_VISIBLE = 0.3  # of a surface that no nearer one hides, for a view to show it openly
LEAST_PIXELS = 64  # of that part
LEAST_COLORED = 0.8  # of it, that have the colour of leaves, for it to become a mask
LEAST_FOUND = 0.3  # of the views that show an instance openly, where its surface agrees with what the detector found
UNSURE = 0.2  # of the masks that agree: no lower are the detection scores of masks that stay although they disagree
PIECE = 0.8  # of a mask, that lies in what the surface shows
ENOUGH, SHARE_SURE = 3, 0.5  # masks that the detector is sure of, for an instance without a credible surface to stay
ROUGH_VIEWS = 12  # of an instance, that tell well enough where all views must show it
SURE_VIEWS = 4  # of an instance whose masks tell that colour
LEAST_PARALLAX = 30.0  # degrees between the views of an instance, from which its surface tells what they show


@dataclass(frozen=True, eq=False)
class _Found:
    """One revised mask: its instance, the old masks in its place, whether it is theirs, and its crop."""

    view: int
    instance: int
    members: list[int]
    is_own: bool
    box: Box
    crop: Tensor


@dataclass(frozen=True, eq=False)
class _Place:
    """What is known of one instance in one view.

    Attributes:
        own: what the detector found; None: nothing.
        shown: what the surface shows, where the photo can show a leaf there; None: it cannot.
        agrees: the two show the same leaf.
        is_open: the view shows enough of the surface to tell.
        is_sure: the detector and the matcher are as sure of `own` as of most masks that agree.
        is_piece: `own` lies within what the surface shows.
    """

    own: _Found | None
    shown: _Found | None = None
    agrees: bool = False
    is_open: bool = False
    is_sure: bool = False
    is_piece: bool = False


def verify_masks(
    masks: Masks,
    *,
    cameras: Cameras,
    photos: Photos | None,
    colors: NDArray[np.bool_] | None = None,
    fit: Fit | None = None,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> tuple[Masks, dict[int, LeafSurface]]:
    """Detections as the other views correct them: surfaces are fitted to them, and they are revised as these say.

    First, masks that show another instance's surface than their own get its id (`move_masks`).

    Args:
        masks: D detections, matched.
        cameras: V cameras.
        photos, colors: see `revise_masks`.
        fit: from the masks to {instance id: surface}; None: `fit_roughly`.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        progress: show progress bars.

    Returns:
        D' masks on the CPU, see `revise_masks`, their ids without gaps. And {instance id: surface}, what they were
        judged by. Where the cameras see the leaves from one side only, by less than `LEAST_PARALLAX`, surfaces are too
        uncertain to judge by: all masks stay, without surfaces, and a warning (InputWarning) says so.
    """
    masks, cameras = masks.to("cpu"), cameras.to("cpu")
    parallax = median_parallax(masks, cameras)
    if parallax < LEAST_PARALLAX:
        message = f"the cameras see the leaves from one side only ({parallax:.0f} degrees apart, as a rule)"
        warnings.warn(f"{message}: the other views cannot verify their masks", InputWarning, stacklevel=2)
        return masks, {}
    surfaces = fit_roughly(masks, cameras, workers=workers, progress=progress) if fit is None else fit(masks)
    masks, surfaces = move_masks(masks, surfaces, cameras=cameras)
    revised = revise_masks(masks, surfaces, cameras=cameras, photos=photos, colors=colors, progress=progress)
    return revised.close_gaps(), revised.renumber(surfaces)


def fit_roughly(
    masks: Masks,
    cameras: Cameras,
    *,
    known: Mapping[int, LeafSurface] = MappingProxyType({}),
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> dict[int, LeafSurface]:
    """{instance id: surface} to verify masks with; for `known` see `fit_surfaces`. It does not warn: what still holds
    after the correction is said then."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return fit_surfaces(
            masks.regions,
            masks.instance_ids,
            cameras,
            known=known,
            most_views=ROUGH_VIEWS,
            is_rough=True,
            workers=workers,
            progress=progress,
        )


def median_parallax(masks: Masks, cameras: Cameras) -> float:
    """Degrees; median over the instances of the largest angle between two lines of sight to their masks; infinite
    without an instance that two views show."""
    boxes = masks.regions.boxes.double()
    centres = torch.cat((boxes[:, :2] + boxes[:, 2:], torch.full_like(boxes[:, :1], 2)), 1) / 2
    sights = (cameras.world_from_px[masks.view_index] @ centres[:, :, None])[..., 0]
    sights = sights / sights.norm(dim=1, keepdim=True)
    angles = []
    for instance in masks.instance_ids[masks.instance_ids > 0].unique().tolist():
        own = sights[masks.instance_ids == instance]
        if len(own) > 1:
            angles.append(torch.rad2deg(torch.acos((own @ own.T).clamp(-1, 1)).max()))
    return float(torch.stack(angles).median()) if angles else float("inf")


def revise_masks(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
    photos: Photos | None,
    colors: NDArray[np.bool_] | None = None,
    progress: bool = False,
) -> Masks:
    """Keep, replace, add and drop masks as the surfaces of their instances say.

    For every instance and view:

    - its masks there stay, as one, when their IoU with the visible part of the surface is at least `AGREES`. Of what
      nearer surfaces hide, that part counts as visible which these masks show, where the view shows the surface openly:
      photos know better what lies in front;
    - masks that disagree stay as well where the detector was sure of them, unless they are pieces: `PIECE` of them lies
      in what the surface shows. It was sure where it scores them no lower than the lowest `UNSURE` of those that agree;
    - otherwise, and where it has none, the visible part becomes its mask, as far as it has the colour of leaves
      (`leaf_color`). It must be `LEAST_VISIBLE` of the surface, so that the view shows it openly, and `LEAST_COLORED`
      of it must have that colour: what a stem or a pot hides, or a wrong surface shows, is no mask;
    - otherwise it has none, or the piece that the detector was sure of.

    Of instances without a credible surface those masks stay that the detector was sure of, if these are `ENOUGH`, and
    half of all (`SHARE_SURE`). All others of them go, and so do instances with masks in one view only, and masks that
    are matched to nothing. A leaf that only one photo shows is lost with the false ones. And those go whose masks
    agreed in fewer than `LEAST_FOUND` of the views that show them openly: what is seen from all sides, and taken for a
    leaf from a few, is a stem or the like.

    Args:
        masks: D masks on the CPU, as a detector found them, matched.
        surfaces: {instance id: surface} fitted to them.
        cameras: V cameras.
        photos: view index -> (H, W, 3) uint8 RGB, undistorted; asked twice for each view. None: there are none, and
            colour tells nothing.
        colors: of leaves, where they are known already; None: those of the masks, see `colors_of_leaves`.
        progress: show a progress bar over the views.

    Masks that a person corrected (`Masks.is_corrected`) are certain: they stay as they are, and so do their instances.

    Returns:
        The D' masks that are left, at most one for each instance and view, by view and instance; ids are as before,
        with gaps where instances went. A mask made of several takes the columns of the largest and the best match score
        of theirs. One that only the other views show has `Origin.OTHER_VIEWS` and the mean scores of its instance.
    """
    ids, held = masks.instance_ids, masks.is_corrected
    certain = {*zip(masks.view_index[held].tolist(), ids[held].tolist(), strict=True)}
    if photos is not None and colors is None:
        colors = colors_of_leaves(masks, photos)
    places: dict[tuple[int, int], _Place] = {}
    for view in tqdm(range(len(cameras)), "verification", unit="view", disable=not progress):
        width, height = cameras.sizes[view].tolist()
        colored = np.ones((height, width), bool)
        if photos is not None and colors is not None:
            colored = has_leaf_color(photos(view), colors)
        places |= _look_at(masks, surfaces, cameras, view=view, colored=colored)
    places = {key: place for key, place in _with_sure(masks, places).items() if key not in certain}
    instances = {instance for _, instance in certain}
    return _with_held(_as_masks(masks, _decide(places, surfaces, certain=instances)), masks.select(held))


def _look_at(
    masks: Masks, surfaces: Mapping[int, LeafSurface], cameras: Cameras, *, view: int, colored: Mask
) -> dict[tuple[int, int], _Place]:
    """What one view shows of every instance; `colored` (H, W) has the colour of leaves."""
    here = masks.view_index == view
    ids = masks.instance_ids
    places, frame = {}, masks.regions.label_map(view, ids.clamp(min=0), cameras.sizes[view].tolist()).numpy()
    own: dict[int, _Found] = {}
    for instance in ids[here & (ids > 0)].unique().tolist():
        members = (here & (ids == instance)).nonzero()[:, 0].tolist()
        box, crop = masks.regions.union(members)
        own[instance] = _found((view, instance), members, (box, crop.numpy()), is_own=True)
        places[view, instance] = _Place(own=own[instance])
    for leaf in visible_leaves(surfaces, cameras, view):
        x1, y1, x2, y2 = leaf.box
        in_box = frame[y1:y2, x1:x2]
        found = own.get(leaf.instance)
        agrees = is_piece = False
        if found is not None:
            detected = found.crop.numpy()
            claimed = leaf.covered & (in_box == leaf.instance) & (leaf.share >= LEAST_VISIBLE)
            seen = replace(leaf, mask=leaf.mask | claimed)
            agrees = agreement(found.box, detected, seen) >= AGREES
            is_piece = inside(found.box, detected, seen) >= PIECE
        colored_here = colored[y1:y2, x1:x2]
        members = [] if found is None else found.members
        shown = None
        if _is_leaf(leaf, colored_here):
            shown = _found((view, leaf.instance), members, (leaf.box, leaf.mask & colored_here), is_own=False)
        places[view, leaf.instance] = _Place(
            own=found, shown=shown, agrees=agrees, is_open=agrees or _is_open(leaf), is_piece=is_piece
        )
    return places


def _with_sure(masks: Masks, places: dict[tuple[int, int], _Place]) -> dict[tuple[int, int], _Place]:
    """The same places, which know of what the detector was sure."""
    scores = {key: float(masks.detection_scores[place.own.members].max()) for key, place in places.items() if place.own}
    agreed = [score for key, score in scores.items() if places[key].agrees and not np.isnan(score)]
    least = float(np.quantile(agreed, UNSURE)) if agreed else np.inf
    return {
        key: replace(
            place,
            is_sure=place.own is not None
            and scores[key] >= least
            and float(masks.match_scores[place.own.members].max()) >= SURE,
        )
        for key, place in places.items()
    }


def _decide(
    places: Mapping[tuple[int, int], _Place], surfaces: Mapping[int, LeafSurface], *, certain: Set[int]
) -> list[_Found]:
    """The masks that stay and those that are added, by view; `certain` instances stay."""
    num_agreeing = Counter(instance for (_, instance), place in places.items() if place.agrees)
    num_open = Counter(instance for (_, instance), place in places.items() if place.is_open)
    num_sure = Counter(instance for (_, instance), place in places.items() if place.is_sure)
    num_found = Counter(instance for (_, instance), place in places.items() if place.own is not None)
    credible = {instance for instance, surface in surfaces.items() if surface.is_credible}
    found = []
    for _, place in sorted(places.items()):
        stays = place.agrees or (place.is_sure and not place.is_piece)
        if not stays and place.shown is not None:
            found.append(place.shown)
        elif (stays or place.is_sure) and place.own is not None:
            found.append(place.own)
    num_masks = Counter(each.instance for each in found)
    borne_out = certain | {
        instance for instance in num_masks
        if (num_masks[instance] > 1 and num_agreeing[instance] >= LEAST_FOUND * num_open[instance]
            if instance in credible else num_sure[instance] >= max(ENOUGH, SHARE_SURE * num_found[instance]))
    }  # fmt: skip
    return [each for each in found if each.instance in borne_out]


def _with_held(revised: Masks, held: Masks) -> Masks:
    """Revised masks and those that stay as they are, by view."""
    if not len(held):
        return revised
    both = Masks.concatenate((revised, held.with_merged(())))
    both = replace(both, instance_ids=torch.cat((revised.instance_ids, held.instance_ids)))
    return both.select(both.view_index.argsort(stable=True))


def _as_masks(masks: Masks, found: list[_Found]) -> Masks:
    """The table of the revised masks, from the one of the old masks."""
    areas, scores = masks.regions.areas, masks.match_scores
    rows = []  # of the old table, that the columns begin with: for what no detector found, any of its instance
    for each in found:
        rows.append(max(each.members, key=lambda row: int(areas[row])) if each.is_own else _first(masks, each.instance))
    is_own = torch.tensor([each.is_own for each in found], dtype=torch.bool)
    best = torch.tensor([float(scores[each.members].max()) if each.is_own else 0.0 for each in found])
    revised = replace_crops(
        masks.select(torch.tensor(rows, dtype=torch.int64)).with_merged(()),
        [each.box for each in found],
        [each.crop for each in found],
    )
    views = torch.tensor([each.view for each in found], dtype=torch.int64)
    labels = torch.arange(1, len(found) + 1)
    detection_scores, classes = revised.detection_scores.clone(), revised.classes.clone()
    for instance in revised.instance_ids[~is_own].unique().tolist():
        of_instance, before = revised.instance_ids == instance, masks.instance_ids == instance
        own = best[of_instance & is_own]
        best[of_instance & ~is_own] = (own if len(own) else scores[before]).mean()
        detection_scores[of_instance & ~is_own] = masks.detection_scores[before].nanmean()
        classes[of_instance & ~is_own] = masks.classes[before].mode()[0]
    revised = revised.with_merged(_still_merged(masks, found))
    return replace(
        revised,
        regions=replace(revised.regions, view_index=views, labels=labels),
        match_scores=best,
        detection_scores=detection_scores,
        classes=classes,
        origin=torch.where(is_own, revised.origin, int(Origin.OTHER_VIEWS)),
    )


def _still_merged(masks: Masks, found: list[_Found]) -> list[MergedMask]:
    """The merged masks that stayed as they were, in views where their second instance has no mask of its own."""
    merged = {each.region: each for each in masks.merged}
    shown = {(each.view, each.instance) for each in found}
    left = {each.instance for each in found}
    return [
        replace(merged[each.members[0]], region=row)
        for row, each in enumerate(found)
        if each.is_own and len(each.members) == 1 and each.members[0] in merged
        and merged[each.members[0]].part.shape == each.crop.shape
        and merged[each.members[0]].other in left and (each.view, merged[each.members[0]].other) not in shown
    ]  # fmt: skip


def _first(masks: Masks, instance: int) -> int:
    return int((masks.instance_ids == instance).nonzero()[0, 0])


def colors_of_leaves(masks: Masks, photos: Photos) -> NDArray[np.bool_]:
    """The colours of masks that are surely matched, of instances that are so in `SURE_VIEWS` views, or in all where
    there are fewer; where there are no such masks, those of all that are matched."""
    enough = masks.count_sure_views() >= min(SURE_VIEWS, masks.regions.num_views)
    of_instance = torch.cat((enough, enough.new_zeros(1)))[masks.instance_ids.clamp(min=0) - 1]
    is_sure = (masks.instance_ids > 0) & of_instance & (masks.match_scores >= SURE)
    chosen = is_sure if is_sure.any() else masks.instance_ids > 0
    counts = ColorCounts.none()
    for view in range(masks.regions.num_views):
        photo = photos(view)
        size = photo.shape[1], photo.shape[0]
        counts += count_colors(photo, masks.regions.label_map(view, chosen.long(), size).numpy() > 0)
    return leaf_colors(counts)


def _is_open(leaf: VisibleLeaf) -> bool:
    """Whether a view shows enough of a surface to tell."""
    return leaf.share >= LEAST_VISIBLE and int(leaf.mask.sum()) >= LEAST_PIXELS


def _is_leaf(leaf: VisibleLeaf, colored: Mask) -> bool:
    """Whether the photo can show a leaf where the other views say that there is one; `colored` is of its box."""
    return _is_open(leaf) and int((leaf.mask & colored).sum()) >= LEAST_COLORED * int(leaf.mask.sum())


def _found(where: tuple[int, int], members: list[int], placed: tuple[Box, Mask], *, is_own: bool) -> _Found:
    """`where`: view and instance."""
    (left, top, _, _), mask = placed
    x1, y1, x2, y2 = mask_box(torch.from_numpy(mask))
    crop = torch.from_numpy(mask[y1:y2, x1:x2].copy())
    box = (left + x1, top + y1, left + x2, top + y2)
    return _Found(view=where[0], instance=where[1], members=members, is_own=is_own, box=box, crop=crop)
