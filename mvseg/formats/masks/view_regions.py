"""From the masks of photos, as files and programs hold them, to regions in the undistorted frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import pycolmap
import torch

from mvseg.crop import Crop
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding, Rule, list_findings
from mvseg.formats.lens import undistort
from mvseg.formats.masks.class_numbers import check_numbers, count_between
from mvseg.regions import Regions, label_boxes, stack_regions
from mvseg.scene import Scene

ViewMasks = np.ndarray | Iterable[tuple[int, np.ndarray]]
SAME = 0.75  # definition: IoU of two masks of one object; that of 20 x 8 pixels, moved by one along both sides, has it
COVERS = 0.8  # chosen: of the photo: the background
INSIDE = 0.9  # chosen: share of a mask that lies in a larger one, from which it is a part of that
MANY = 0.2  # chosen: share of the masks that are such parts, above which they are no leaves that hide each other


def stack_views(views: Iterable[ViewMasks], scene: Scene | None, *, source: object) -> Regions:
    """The regions of all views, with the lens distortion of the scene removed; one mask is in memory at a time, if the
    views are iterators.

    Args:
        views: V times a label map (H, W) uint16 (0 = nothing, 65535 = ignore), or pairs of a number and a mask (H, W)
            bool, which may overlap; in the frame of the photo.
        scene: gives the lenses; None for masks of undistorted photos.

    Returns:
        Regions ordered by view; `labels` holds the numbers. Warns (InputWarning) of masks that are left out: those
        without pixels, empty or not shown by the undistorted photo, and those that stand twice in one view, or nearly
        (`SAME`); and of findings of `check_numbers` in label maps and of `mask_faults` in masks of a scene.

    Raises:
        InputError: there are masks, and none has a pixel; or see `check_numbers`. Messages name `source`.
    """
    rows: list[tuple[int, Crop, int]] = []
    between, num_views, num_empty = np.zeros(2, np.int64), 0, 0
    for view, content in enumerate(views):
        lens = None if scene is None else scene.views[view].lens
        K = np.eye(3) if scene is None else scene.cameras.K[view].cpu().numpy()
        if isinstance(content, np.ndarray):
            between += count_between(content)
            parts = _crop_labels(content, lens, K)
        else:
            parts = ((label, Crop.of(undistort(mask.view(np.uint8), lens, K).view(bool))) for label, mask in content)
        for label, crop in parts:
            if crop.pixels.any():
                rows.append((view, crop, label))
            else:
                num_empty += 1
        num_views += 1
    if num_empty and not rows:
        what = f"{num_empty} masks show no pixel (empty, or outside of the undistorted photo)"
        raise InputError(f"{source}: {what}, and no others are there")
    if num_empty:
        warn(Finding("masks_without_pixels", str(source), {"count": num_empty}))
    regions = _without_copies(stack_regions(rows, num_views), source=source)
    if between[0]:
        check_numbers(regions, between, source=source)
    if scene is not None and len(regions):  # without any, a run says so
        names = [view.name for view in scene.views]
        for fault in list_findings(mask_faults(regions, scene.cameras.sizes.tolist()), names):
            warn(fault)
    return regions


def _crop_labels(labels: np.ndarray, lens: pycolmap.Camera | None, K: np.ndarray) -> Iterator[tuple[int, Crop]]:
    """The numbers of a label map; a crop without a pixel where the undistorted photo does not show one."""
    label_map = undistort(labels, lens, K)
    boxes = label_boxes(label_map)
    for number in boxes if lens is None else label_boxes(labels):
        x1, y1, x2, y2 = box = boxes.get(number, (0, 0, 1, 1))
        yield number, Crop(box, torch.from_numpy(label_map[y1:y2, x1:x2] == number))


def _without_copies(regions: Regions, *, source: object) -> Regions:
    is_copy, areas = torch.zeros(len(regions), dtype=torch.bool), regions.areas.tolist()
    for one, other, shared in regions.overlaps():
        if not is_copy[one] and shared >= SAME * (areas[one] + areas[other] - shared):
            is_copy[other] = True
    if is_copy.any():
        warn(Finding("copies", str(source), {"count": int(is_copy.sum()), "total": len(regions), "iou": SAME}))
    return regions.select(~is_copy)


def mask_faults(regions: Regions, sizes: Sequence[Sequence[int]]) -> list[Rule]:
    """The faults of the masks of V views of these sizes (width and height, pixels)."""
    counts = regions.num_per_view.cpu().numpy()
    if not counts.any():
        return [("no_masks", "error", None, {})]
    faults: list[Rule] = []
    if np.count_nonzero(counts) < 2:
        faults.append(("masks_in_one_view", "error", np.flatnonzero(counts == 0).tolist(), {}))
    areas, views = regions.areas.tolist(), regions.view_index.tolist()
    whole = {view for view, area in zip(views, areas, strict=True) if area > COVERS * sizes[view][0] * sizes[view][1]}
    faults.append(("background_mask", "error", sorted(whole), {"share": COVERS}))
    inside = [pair for *pair, shared in regions.overlaps() if shared >= INSIDE * min(areas[row] for row in pair)]
    parts = {min(pair, key=lambda row: areas[row]) for pair in inside}
    if len(parts) > MANY * len(areas):
        values = {"count": len(parts), "total": len(areas)}
        faults.append(("masks_inside_masks", "error", sorted({views[row] for row in parts}), values))
    return faults
