"""Stage 5d: masks that cover two instances, and which part of them shows the second one."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.matching.nview.cluster_scores import (
    Costs,
    Known,
    known_landings,
    known_own_scores,
    members_of,
    pixel_scores,
    view_bounds,
)
from mvseg.matching.nview.label_rows import RowTable
from mvseg.regions import Regions

Ints = NDArray[np.int64]
NEIGHBOURS = 3  # sampled pixels that decide for the pixels around them


def merged_regions(table: RowTable, ids: Ints, costs: Costs, known: Known) -> Ints:
    """Masks that cover two instances: two clusters explain disjoint parts of them.

    A cluster that has no region in a view, but lands on one that belongs to another cluster, may share it. A pixel is
    explained by a cluster when it scores at least half of what the cluster's regions score in the median. Of several
    such clusters that one shares it which explains most pixels that the region's own cluster does not.

    Args:
        table: rows of D regions.
        ids: (D,) cluster of each region in [0, K).
        costs: thresholds, and costs of views that do not show a cluster.
        known: what is found about clusters is added.

    Returns:
        (M, 3) int64: region, its cluster, the other one.
    """
    bounds, views = view_bounds(table), table.view_index
    landing, own = known_landings(table, ids, costs, known), known_own_scores(table, ids, costs, known)
    clusters = members_of(ids, len(landing))
    usual = np.array([np.median(own[members]) for members in clusters])
    is_real = np.array([len(np.unique(views[members])) >= max(2, costs.few * table.num_views) for members in clusters])
    found: list[tuple[int, int, int]] = []
    for view in np.unique(views).tolist():
        regions, pixels, _ = bounds.of(view)
        here = np.arange(regions.start, regions.stop)
        is_second = (landing[:, here] >= costs.merged_landing) & is_real[:, None] & is_real[ids[here]]
        is_second[ids[here]] = False
        shared = here[is_second.any(0)]
        if not len(shared):
            continue
        asked = np.union1d(np.flatnonzero(is_second.any(1)), ids[shared])
        column = np.full(len(clusters), len(asked))
        column[asked] = np.arange(len(asked))
        scores = pixel_scores(table, np.where(views == view, len(asked), column[ids]), view, bounds, costs)
        is_explained = scores >= 0.5 * usual[asked]
        for region in shared.tolist():
            pair = np.append(ids[region], np.flatnonzero(is_second[:, region - regions.start]))
            part = is_explained[table.pixel_region[pixels] == region][:, column[pair]]
            share = (part & ~part[:, :1]).mean(0)
            best = int(share.argmax())
            if share[best] >= costs.merged_share:
                found.append((region, int(pair[0]), int(pair[best])))
    return np.array(found, np.int64).reshape(-1, 3)


def second_part(regions: Regions, table: RowTable, ids: Ints, region: int, second: int, costs: Costs) -> Tensor:
    """Where a merged mask shows its second instance: where its cluster explains the nearest sampled pixels better.

    Args:
        regions: D regions ordered by view.
        table: their rows.
        ids: (D,) cluster of each region in [0, K).
        region: the merged one.
        second: the other cluster.
        costs: of views that do not show a cluster.

    Returns:
        (h, w) bool on the CPU, in the region's box and inside its mask; nowhere for a region without sampled pixels.
    """
    view, bounds = int(table.view_index[region]), view_bounds(table)
    asked = np.where(ids == ids[region], 0, np.where(ids == second, 1, 2))
    asked[table.view_index == view] = 2
    pixels = bounds.of(view)[1]
    here = table.pixel_region[pixels] == region
    scores = pixel_scores(table, asked, view, bounds, costs)[here]
    mask = regions.crop(region).cpu()
    part, spots = torch.zeros_like(mask), mask.nonzero()
    if not here.any():
        return part
    sampled = torch.from_numpy(table.pixel_xy[pixels][here]) - regions.boxes[region, :2].cpu()
    nearest = torch.cdist(spots.flip(1) + 0.5, sampled).topk(min(NEIGHBOURS, len(sampled)), largest=False).indices
    speaks = torch.from_numpy(scores[:, 1] - scores[:, 0])[nearest].mean(1)
    part[spots[:, 0], spots[:, 1]] = speaks > 0
    return part
