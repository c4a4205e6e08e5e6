"""From the masks of photos, as files and programs hold them, to regions in the undistorted frame."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from mvseg.errors import InputWarning
from mvseg.formats.lens import undistort
from mvseg.regions import Regions, regions_from_label_maps, stack_regions
from mvseg.scene import Scene

ViewMasks = np.ndarray | Iterable[tuple[int, np.ndarray]]


def stack_views(
    views: Iterable[ViewMasks], scene: Scene | None, *, source: object, num_views: int | None = None
) -> Regions:
    """The regions of all views, with the lens distortion of the scene removed; one mask is in memory at a time, if the
    views are iterators.

    Args:
        views: V times a label map (H, W) uint16 (0 = nothing, 65535 = ignore), or pairs of a number and a mask (H, W)
            bool, which may overlap; in the frame of the photo.
        scene: gives the lenses; None for masks of undistorted photos.
        source: where the masks come from; the warning names it.
        num_views: V, if there is no scene.

    Returns:
        Regions ordered by view; `labels` holds the numbers. Warns (InputWarning) of masks without pixels, which are
        left out: empty ones, and those that the undistorted photo does not show.
    """
    view_index: list[int] = []
    boxes: list[tuple[int, int, int, int]] = []
    crops: list[Tensor] = []
    labels: list[int] = []
    num_empty = 0
    for view, content in enumerate(views):
        lens = None if scene is None else scene.views[view].lens
        K = np.eye(3) if scene is None else scene.cameras.K[view].cpu().numpy()
        if isinstance(content, np.ndarray):
            part = regions_from_label_maps([undistort(content, lens, K)])
            num_empty += len(np.setdiff1d(content, [0, 65535])) - len(part)
            found = _items(part)
        else:
            found = []
            for label, mask in content:
                shown = undistort(mask.view(np.uint8), lens, K).view(bool)
                if shown.any():
                    found.append((*_crop(shown), label))
                else:
                    num_empty += 1
        for box, crop, label in found:
            view_index.append(view)
            boxes.append(box)
            crops.append(crop)
            labels.append(label)
    if num_empty:
        message = f"{num_empty} masks show no pixel (empty, or outside of the undistorted photo) and are left out"
        warnings.warn(f"{source}: {message}", InputWarning, stacklevel=3)
    num_views = num_views or 0 if scene is None else len(scene.views)
    return stack_regions(view_index, boxes, crops, labels=labels, num_views=num_views)


Box = tuple[int, int, int, int]


def _items(part: Regions) -> list[tuple[Box, Tensor, int]]:
    items: list[tuple[Box, Tensor, int]] = []
    for index in range(len(part)):
        x1, y1, x2, y2 = part.boxes[index].tolist()
        items.append(((x1, y1, x2, y2), part.crop(index).flatten(), int(part.labels[index])))
    return items


def _crop(mask: np.ndarray) -> tuple[tuple[int, int, int, int], Tensor]:
    """The box of a mask with pixels, and its crop, flat."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    y1, y2, x1, x2 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    return (x1, y1, x2, y2), torch.from_numpy(mask[y1:y2, x1:x2].flatten())
