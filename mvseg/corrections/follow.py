"""What follows from edits once surfaces are known: masks that surfaces must not move, and other views of drawn ones."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import torch
from torch import Tensor

from mvseg.corrections.apply import Corrected
from mvseg.formats.photos import Photos
from mvseg.masks import Masks, Origin
from mvseg.scene import Cameras
from mvseg.verification.other_views import verify_masks


def linked_masks(corrected: Corrected | None) -> Tensor | None:
    """(D,) bool, the masks that a person links with others; None without any, or where the rows are others by now."""
    if corrected is None or corrected.everywhere or not len(corrected.links):
        return None
    is_linked = torch.zeros(len(corrected.masks), dtype=torch.bool)
    is_linked[torch.cat((corrected.links.must, corrected.links.cannot)).flatten()] = True
    return is_linked


def add_other_views(
    masks: Masks, cameras: Cameras, *, photos: Photos, workers: ProcessPoolExecutor | None = None
) -> Masks:
    """Instances that a person drew get masks in the other views, as their surfaces say; all other masks stay.

    Args:
        masks: D matched masks.
        cameras: V cameras.
        photos: of the scene, if they exist.
        workers: see `verify_masks`.

    Returns:
        The same masks where nothing was drawn; else these and the new ones, on the CPU.
    """
    is_drawn = (masks.origin == Origin.CORRECTED) & (masks.instance_ids > 0)
    if not is_drawn.any():
        return masks
    drawn = masks.instance_ids[is_drawn].cpu()
    every = torch.ones(len(masks), dtype=torch.bool)
    seen = photos if photos.exist else None
    after, _ = verify_masks(masks, cameras=cameras, photos=seen, held=every, workers=workers)
    return after.select((after.origin != Origin.OTHER_VIEWS) | torch.isin(after.instance_ids, drawn))
