"""From the masks of photos, as files and programs hold them, to regions in the undistorted frame."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from mvseg.errors import warn
from mvseg.formats.lens import undistort
from mvseg.regions import IGNORE_LABEL, Regions, mask_box, regions_from_label_maps, stack_regions
from mvseg.scene import Scene

ViewMasks = np.ndarray | Iterable[tuple[int, np.ndarray]]
Box = tuple[int, int, int, int]


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
    found: list[tuple[int, Box, Tensor, int]] = []
    num_empty = 0
    for view, content in enumerate(views):
        lens = None if scene is None else scene.views[view].lens
        K = np.eye(3) if scene is None else scene.cameras.K[view].cpu().numpy()
        if isinstance(content, np.ndarray):
            part = regions_from_label_maps([undistort(content, lens, K)])
            num_empty += len(np.setdiff1d(content, [0, IGNORE_LABEL])) - len(part)
            for index, ((x1, y1, x2, y2), label) in enumerate(
                zip(part.boxes.tolist(), part.labels.tolist(), strict=True)
            ):
                found.append((view, (x1, y1, x2, y2), part.crop(index).flatten(), label))
            continue
        for label, mask in content:
            shown = undistort(mask.view(np.uint8), lens, K).view(bool)
            if shown.any():
                x1, y1, x2, y2 = mask_box(torch.from_numpy(shown))
                found.append((view, (x1, y1, x2, y2), torch.from_numpy(shown[y1:y2, x1:x2].flatten()), label))
            else:
                num_empty += 1
    if num_empty:
        warn(f"{source}: {num_empty} masks show no pixel (empty, or outside of the undistorted photo) and are left out")
    num_views = num_views or 0 if scene is None else len(scene.views)
    view_index, boxes, crops, labels = zip(*found, strict=True) if found else ((), (), (), ())
    return stack_regions(view_index, boxes, crops, labels=labels, num_views=num_views)
