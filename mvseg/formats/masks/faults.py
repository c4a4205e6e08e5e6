"""Faults that make masks useless, or their ids wrong: errors of `mvseg check`, which every command reports."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvseg.findings.finding import Rule
from mvseg.regions import Regions

COVERS = 0.8  # chosen: of the photo: the background
INSIDE = 0.9  # chosen: share of a mask that lies in a larger one, from which it is a part of that
MANY = 0.2  # chosen: share of the masks that are such parts, above which they are no leaves that hide each other


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
