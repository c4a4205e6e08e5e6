"""Parts of leaves that their masks lack: the other views show them.

A detector that does not know a species cuts off tips and edges, here more, there less. The surface of a leaf is fitted
to all of its masks. Where it reaches beyond a mask, over pixels that have the colour of leaves and are in no mask, the
mask is probably too small. A surface errs, too, and one view proves nothing: the masks of a leaf are completed only if
most of them lack a part. Colours then decide where its edge is (`snap_edges.py`). Not in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mvseg.crop import Crop
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.evidence import paint_view
from mvseg.verification.leaf_color import colors_of_leaves, has_leaf_color
from mvseg.verification.numbers import SNAP


def find_missing_parts(
    masks: Masks, surfaces: Mapping[int, LeafSurface], photos: ReadPhoto, *, cameras: Cameras
) -> list[Crop | None]:
    """Find the part of its leaf that each mask lacks.

    Args:
        masks: D masks with ids, on the CPU.
        surfaces: {instance id: surface} of some of them.

    Returns:
        D crops, disjoint from all masks of their view; None where nothing is missing, or most masks of the leaf are
        whole: they lack less than `SNAP.lacks` of themselves and the missing part together (median over the views that
        show the surface).
    """
    regions, ids = masks.regions, masks.instance_ids.numpy()
    parts: list[Crop | None] = [None] * len(ids)
    lacks = np.full(len(ids), np.nan)
    if not surfaces or not len(ids):
        return parts
    colors = colors_of_leaves(masks, photos)
    for view in regions.view_index.unique().tolist():
        rows = (regions.view_index == view).nonzero()[:, 0].tolist()
        painted, photo = paint_view(surfaces, cameras, view), photos(view)
        for crop in map(regions.placed, rows):
            shown, pixels = crop.cut(painted), crop.pixels.numpy()
            shown[pixels] = -np.abs(shown[pixels])  # in a mask: not missing
        is_missing = (painted > 0) & has_leaf_color(photo, colors)
        for row in rows:
            part = is_missing & (painted == ids[row])
            if part.any() or (painted == -ids[row]).any():
                lacks[row] = part.sum() / (part.sum() + int(regions.areas[row]))
            if part.any():
                parts[row] = Crop.of(part)
    for leaf in np.unique(ids):
        here = lacks[(ids == leaf) & ~np.isnan(lacks)]
        if not len(here) or np.median(here) < SNAP.lacks:
            for row in np.flatnonzero(ids == leaf):
                parts[row] = None
    return parts
