"""Starts of the search: soft multi-view stereo on region labels, before there is any cluster.

How likely two regions are one instance follows from which row of each ray is right, and the reverse: EM estimates both.
Average linkage of the affinity gives the clusters that the search refines.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.matching.nview.label_rows import EMPTY, PLENTY, RowTable, run_starts
from mvseg.matching.one_per_view import ViewGraph, link_average

SHARPNESS = (8.0, 12.0, 16.0, 24.0, 32.0, 32.0)  # of the soft maximum over the rows of a pixel, one per iteration
EMPTY_COST = 0.7  # of a row in which all views show no region
EM_PIXELS = 12  # pixels per region, at most
STARTS = ((-1, 0.3), (1, 0.1))  # iteration whose affinity is clustered, and where the linkage stops
MANY_VIEWS = 8  # with more than this, one start will do

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def soft_starts(table: RowTable) -> list[Ints]:
    """One or, with few views, two partitions (D,) to start the search from; clusters in [0, K)."""
    history = em_affinities(table)
    starts = STARTS[: 1 if table.num_views > MANY_VIEWS else None]
    graphs = [ViewGraph(history[iteration], table.view_index, table.num_views) for iteration, _ in starts]
    return [link_average(graph, stop) for graph, (_, stop) in zip(graphs, starts, strict=True)]


def em_affinities(table: RowTable) -> list[NDArray[np.floating]]:
    """How likely two regions are one instance, from the rows alone, by expectation maximisation.

    E step: the rows of a pixel share one unit of belief by a soft maximum of their mean affinity between all regions
    that they name (the pixel's own included), less EMPTY_COST for views that show nothing. M step: the affinity of
    region n to m is the belief in rows with m, averaged over the pixels of n, and made symmetric.

    Args:
        table: rows of D regions.

    Returns:
        The affinity after each iteration: (D, D) float64 in [0, 1], symmetric, 0 within a view.
    """
    num, owner_of = len(table.view_index), table.pixel_region
    most = max(1, round(EM_PIXELS * min(1, PLENTY / table.num_views)))
    counts = np.bincount(owner_of, minlength=num)
    rank = np.arange(len(owner_of)) - np.searchsorted(owner_of, owner_of)
    is_used = rank % np.maximum(1, -(-counts // most))[owner_of] == 0
    rows = is_used[table.pixel]
    pixel, owner = table.pixel[rows], torch.from_numpy(owner_of[table.pixel[rows]])
    labels = torch.from_numpy(table.labels[rows].astype(np.int64))
    num_empty, num_inside = (labels == EMPTY).sum(1), (labels >= EMPTY).sum(1)
    labels = torch.where(labels < 0, num, labels).T.contiguous()  # column `num` collects what is no region
    pixels = torch.from_numpy(np.maximum(np.bincount(owner_of[is_used], minlength=num), 1))[:, None]
    start = run_starts(pixel)
    run = torch.from_numpy(np.repeat(np.arange(len(start)), np.diff(np.append(start, len(pixel)))))
    cell = owner * (num + 1) + labels
    if not len(start):
        return [np.zeros((num, num))] * len(SHARPNESS)
    shown = torch.unique(run * (num + 1) + labels)
    first_cell = owner[torch.from_numpy(start)][shown // (num + 1)] * (num + 1) + shown % (num + 1)
    A = torch.bincount(first_cell, minlength=num * (num + 1)).reshape(num, num + 1)[:, :num] / pixels
    history = []
    for beta in SHARPNESS:
        flat = torch.nn.functional.pad((A + A.T).float() / 2, (0, 1, 0, 1)).flatten()
        score = flat[cell].sum(0)
        for view, base in enumerate(labels * (num + 1)):
            for other in range(view + 1, len(labels)):
                score += flat[base + labels[other]]
        score = 2 * score / (num_inside * (num_inside + 1)) - EMPTY_COST * num_empty / num_inside
        best = torch.from_numpy(np.maximum.reduceat(score.numpy(), start))
        belief = torch.exp(beta * (score - best[run])).double()
        belief /= torch.bincount(run, belief)[run]
        mass = torch.bincount(cell.flatten(), belief.expand(cell.shape).flatten(), minlength=num * (num + 1))
        A = mass.reshape(num, num + 1)[:, :num] / pixels
        history.append(((A + A.T) / 2).numpy())
    return history
