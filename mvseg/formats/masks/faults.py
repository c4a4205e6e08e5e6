"""What makes masks of any kind useless, or their ids wrong: the errors of `mvseg check`, which every command says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvseg.regions import Regions

COVERS = 0.8  # of the photo: the background
INSIDE = 0.9  # share of a mask that lies in a larger one, from which it is a part of that
MANY = 0.2  # share of the masks that are such parts, above which they are no leaves that hide each other
Fault = tuple[Sequence[int] | None, str]  # views (None: the whole scene), and a sentence in which "{}" stands for them


def mask_faults(regions: Regions, sizes: Sequence[Sequence[int]]) -> list[Fault]:
    """The faults of the masks of V views of these sizes (width and height, pixels)."""
    counts = regions.num_per_view.cpu().numpy()
    if not counts.any():
        return [(None, "the masks of all views are empty: there are no instances to match")]
    faults: list[Fault] = []
    if np.count_nonzero(counts) < 2:
        what = "only one view has masks, so that there is nothing to match: segment the other photos"
        faults.append((np.flatnonzero(counts == 0).tolist(), what))
    areas, views = regions.areas.tolist(), regions.view_index.tolist()
    whole = {view for view, area in zip(views, areas, strict=True) if area > COVERS * sizes[view][0] * sizes[view][1]}
    what = f"a mask covers more than {COVERS:.0%} of {{}}: if it is the background, make it 0"
    if whole:
        faults.append((sorted(whole), what))
    inside = [pair for *pair, shared in regions.overlaps() if shared >= INSIDE * min(areas[row] for row in pair)]
    parts = {min(pair, key=lambda row: areas[row]) for pair in inside}
    if len(parts) > MANY * len(areas):
        what = f"{len(parts)} of {len(areas)} masks lie inside of other masks, in {{}}: wholes and parts count as "
        what += "leaves of their own, so keep one mask for each leaf"
        faults.append((sorted({views[row] for row in parts}), what))
    return faults
