"""Parts of leaves that their masks lack: the other views show them. Not in the paper.

A detector that does not know a species cuts off tips and edges, here more, there less. Where the surface of a leaf
reaches beyond a mask, over leaf-coloured free pixels, the mask is probably too small. One view proves nothing: the
masks of a leaf are completed only if most of them lack a part. Colours then decide where its edge is (`snap_edges.py`).
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
from mvseg.verification.numbers import SNAP
from mvseg.verification.picture import FREE, OTHER, ViewPicture, colors_of_leaves


def find_missing_parts(
    masks: Masks, surfaces: Mapping[int, LeafSurface], photos: ReadPhoto, *, cameras: Cameras
) -> list[Crop | None]:
    """Find the part of its leaf that each of D masks on the CPU lacks.

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
        painted = paint_view(surfaces, cameras, view)
        picture = ViewPicture.of(masks, photos, view).show(colors)
        for row in (regions.view_index == view).nonzero()[:, 0].tolist():
            part = (painted == ids[row]) & (picture == FREE)
            if part.any() or ((painted == ids[row]) & (picture != OTHER)).any():
                lacks[row] = part.sum() / (part.sum() + int(regions.areas[row]))
            if part.any():
                parts[row] = Crop.of(part)
    for leaf in np.unique(ids):
        here = lacks[(ids == leaf) & ~np.isnan(lacks)]
        if not len(here) or np.median(here) < SNAP.lacks:
            for row in np.flatnonzero(ids == leaf):
                parts[row] = None
    return parts
