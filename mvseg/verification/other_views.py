"""The other views as witnesses: they correct the masks that a detector found.

A surface that is fitted to an instance's masks in all views says where each view must show it. That settles what no
photo can by itself: which piece of a leaf is the leaf, which mask is none, and which leaf was missed. Not in the paper.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputWarning
from mvseg.masks import Proposals
from mvseg.matching.result import SURE, Matching, count_sure_views
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions, mask_box, stack_regions
from mvseg.scene import Cameras
from mvseg.verification.leaf_color import ColorCounts, count_colors, has_leaf_color, leaf_colors
from mvseg.verification.recut import AGREES, Box, Mask, agreement
from mvseg.verification.sure_masks import confirmed_masks
from mvseg.verification.visible_leaves import VisibleLeaf, visible_leaves

Photos = Callable[[int], NDArray[np.uint8]]

LEAST_VISIBLE = 0.3  # of a surface that no nearer one hides, for a view to show it openly
LEAST_PIXELS = 64  # of that part
LEAST_COLORED = 0.8  # of it, that have the colour of leaves, for it to become a mask
LEAST_FOUND = 0.3  # of the views that show an instance openly, where its surface agrees with what the detector found
ROUGH_VIEWS = 12  # of an instance, that tell well enough where all views must show it
SURE_VIEWS = 4  # of an instance whose masks tell that colour


@dataclass(frozen=True, eq=False)
class Revised:
    """Masks after the other views were heard.

    Attributes:
        regions: D' masks, at most one for each instance and view.
        matching: their ids, 1 to K' without gaps, in the order of the old ones.
        source: (D',) int64, the largest of the regions that a mask was made of; -1 for one that only the other views
            show.
        old_ids: (K',) int64, the former id of each instance.
    """

    regions: Regions
    matching: Matching
    source: Tensor
    old_ids: Tensor


@dataclass(frozen=True, eq=False)
class _Found:
    """One revised mask: its instance, the old masks in its place, whether it is theirs, and its crop."""

    view: int
    instance: int
    members: list[int]
    is_own: bool
    box: Box
    crop: Tensor


def hear_witnesses(
    proposals: Proposals,
    matching: Matching,
    *,
    cameras: Cameras,
    photos: Photos,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> tuple[Proposals, Matching, dict[int, LeafSurface]]:
    """Detections as the other views correct them: surfaces are fitted to them, and they are revised as these say.

    Args:
        proposals: D detections.
        matching: of these.
        cameras: V cameras.
        photos: view index -> (H, W, 3) uint8 RGB, undistorted; asked twice for each view.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        progress: show progress bars.

    Returns:
        D' detections with `from_views`, on the CPU, and their matching, see `revise_masks`; a mask that only the other
        views show has the mean detection score of its instance. And {instance id: surface}, what they were judged by.
    """
    regions, ids = proposals.regions.to("cpu"), matching.instance_ids.cpu()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # what still holds after the correction is said then
        surfaces = fit_surfaces(
            regions, ids, cameras.to("cpu"), most_views=ROUGH_VIEWS, workers=workers, progress=progress
        )
    revised = revise_masks(regions, matching, surfaces, cameras=cameras.to("cpu"), photos=photos, progress=progress)
    from_views, new_ids = revised.source < 0, revised.matching.instance_ids
    old_scores, old_classes = proposals.scores.cpu(), proposals.classes.cpu()
    scores, classes = old_scores[revised.source], old_classes[revised.source]
    for number in new_ids[from_views].unique().tolist():
        of_instance = revised.old_ids[number - 1] == ids
        scores[from_views & (new_ids == number)] = old_scores[of_instance].mean()
        classes[from_views & (new_ids == number)] = old_classes[of_instance].mode()[0]
    corrected = Proposals(
        regions=revised.regions,
        boxes=revised.regions.boxes.float(),
        scores=scores,
        classes=classes,
        from_views=from_views,
    )
    judged_by = {number: surfaces[old] for number, old in enumerate(revised.old_ids.tolist(), start=1)}
    return corrected, revised.matching, judged_by


def revise_masks(
    regions: Regions,
    matching: Matching,
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
    photos: Photos,
    progress: bool = False,
) -> Revised:
    """Keep, replace, add and drop masks as the surfaces of their instances say.

    For every instance and view:

    - its masks there stay, as one, when their IoU with the visible part of the surface is at least `AGREES`;
    - otherwise, and where it has none, that part becomes its mask, as far as it has the colour of leaves
      (`leaf_color`). It must be `LEAST_VISIBLE` of the surface, so that the view shows it openly, and `LEAST_COLORED`
      of it must have that colour: what a stem or a pot hides, or a wrong surface shows, is no mask;
    - otherwise it has none.

    Instances without a credible surface go, and those with masks in one view only; so do masks that are matched to
    nothing. A leaf that only one photo shows is lost with the false ones. And those go whose masks stayed in fewer than
    `LEAST_FOUND` of the views that show them openly: what is seen from all sides, and taken for a leaf from a few, is a
    stem or the like.

    Args:
        regions: D masks, as a detector found them.
        matching: their ids.
        surfaces: {instance id: surface} fitted to them.
        cameras: V cameras.
        photos: view index -> (H, W, 3) uint8 RGB, undistorted; asked twice for each view.
        progress: show a progress bar over the views.

    Returns:
        The masks and their ids, on the CPU. A mask made of several has the best match score of theirs; one that only
        the other views show has the mean of its instance's.
    """
    ids, scores = matching.instance_ids.cpu(), matching.match_scores.cpu()
    regions, matching = regions.to("cpu"), replace(matching, instance_ids=ids, match_scores=scores)
    colors = _colors_of_leaves(regions, matching, photos)
    found: list[_Found] = []
    shown_openly: Counter[int] = Counter()
    for view in tqdm(range(regions.num_views), "witnesses", unit="view", disable=not progress):
        colored = has_leaf_color(photos(view), colors)
        for leaf in visible_leaves(surfaces, cameras, view):
            members = ((regions.view_index == view) & (ids == leaf.instance)).nonzero()[:, 0].tolist()
            x1, y1, x2, y2 = leaf.box
            colored_here = colored[y1:y2, x1:x2]
            box, own = regions.union(members) if members else (leaf.box, torch.zeros(leaf.mask.shape, dtype=torch.bool))
            is_own = agreement(box, own.numpy(), leaf) >= AGREES
            shown_openly[leaf.instance] += is_own or _is_open(leaf)
            if is_own:
                found.append(_found(view, leaf, members, (box, own.numpy()), is_own=True))
            elif _is_leaf(leaf, colored_here):
                found.append(_found(view, leaf, members, (leaf.box, leaf.mask & colored_here), is_own=False))
    found = _borne_out(found, shown_openly)
    number = {instance: place for place, instance in enumerate(sorted({each.instance for each in found}), start=1)}
    revised = stack_regions(
        [each.view for each in found],
        [each.box for each in found],
        [each.crop for each in found],
        labels=range(1, len(found) + 1),
        num_views=regions.num_views,
    )
    areas = regions.areas
    source = [max(each.members, key=lambda n: int(areas[n])) if each.is_own else -1 for each in found]
    return Revised(
        regions=revised,
        matching=_rematch(matching, found, number),
        source=torch.tensor(source, dtype=torch.int64),
        old_ids=torch.tensor(list(number), dtype=torch.int64),
    )


def _colors_of_leaves(regions: Regions, matching: Matching, photos: Photos) -> NDArray[np.bool_]:
    """The colours of masks that are surely matched in `SURE_VIEWS` views, or in all where there are fewer; where there
    are no such masks, those of all that are matched."""
    is_sure = confirmed_masks(regions, matching, min_match_score=SURE, min_views=SURE_VIEWS)
    chosen = is_sure if is_sure.any() else matching.instance_ids > 0
    counts = ColorCounts.none()
    for view in range(regions.num_views):
        photo = photos(view)
        size = photo.shape[1], photo.shape[0]
        counts += count_colors(photo, regions.label_map(view, chosen.long(), size).numpy() > 0)
    return leaf_colors(counts)


def _is_open(leaf: VisibleLeaf) -> bool:
    """Whether a view shows enough of a surface to tell."""
    return leaf.share >= LEAST_VISIBLE and int(leaf.mask.sum()) >= LEAST_PIXELS


def _is_leaf(leaf: VisibleLeaf, colored: Mask) -> bool:
    """Whether the photo can show a leaf where the other views say that there is one; `colored` is of its box."""
    return _is_open(leaf) and int((leaf.mask & colored).sum()) >= LEAST_COLORED * int(leaf.mask.sum())


def _found(
    view: int, leaf: VisibleLeaf, members: list[int], placed: tuple[Box, Mask], *, is_own: bool
) -> _Found:
    (left, top, _, _), mask = placed
    x1, y1, x2, y2 = mask_box(torch.from_numpy(mask))
    crop = torch.from_numpy(mask[y1:y2, x1:x2].copy()).flatten()
    box = (left + x1, top + y1, left + x2, top + y2)
    return _Found(view=view, instance=leaf.instance, members=members, is_own=is_own, box=box, crop=crop)


def _borne_out(found: list[_Found], shown_openly: Mapping[int, int]) -> list[_Found]:
    """Without the instances that have a mask in one view only, or that the detector found in too few of the views that
    show them openly (`shown_openly`: how many these are)."""
    masks = Counter(each.instance for each in found)
    seen = Counter(each.instance for each in found if each.is_own)
    return [
        each for each in found
        if masks[each.instance] > 1 and seen[each.instance] >= LEAST_FOUND * shown_openly[each.instance]
    ]  # fmt: skip


def _rematch(matching: Matching, found: list[_Found], number: Mapping[int, int]) -> Matching:
    """The matching of the revised masks."""
    ids = torch.tensor([number[each.instance] for each in found], dtype=torch.int64)
    is_own = torch.tensor([each.is_own for each in found], dtype=torch.bool)
    scores = torch.tensor([float(matching.match_scores[each.members].max()) if each.is_own else 0.0 for each in found])
    for instance in ids[~is_own].unique().tolist():
        scores[~is_own & (ids == instance)] = scores[is_own & (ids == instance)].mean().nan_to_num(0)
    revised = Matching(
        instance_ids=ids,
        match_scores=scores,
        num_instances=len(number),
        method=matching.method,
        residual_px=matching.residual_px,
        explained=matching.explained,
        poses=matching.poses,
    )
    if matching.support is None:
        return revised
    view_index = torch.tensor([each.view for each in found], dtype=torch.int64)
    return replace(revised, support=count_sure_views(revised, view_index))
