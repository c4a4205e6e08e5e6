"""Starts of the search: soft multi-view stereo on region labels, before there is any cluster.

How likely two regions are one instance follows from which row of each ray is right, and the reverse: EM estimates both.
Average linkage of the affinity gives the clusters that the search refines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvseg.matching.nview.label_rows import BLOCK_ROWS, EMPTY, PLENTY, RowTable, blocks_of_runs, run_starts
from mvseg.matching.one_per_view import ViewGraph, link_average

SHARPNESS = (8.0, 12.0, 16.0, 24.0, 32.0, 32.0)  # of the soft maximum over the rows of a pixel, one per iteration
EMPTY_COST = 0.7  # of a row in which all views show no region
EM_PIXELS = 12  # pixels per region, at most
NEGLIGIBLE = 1e-5  # belief in a row that is not spread
EM_VIEWS = 30  # of a row are compared with each other, at most
STARTS = ((-1, 0.3), (1, 0.1))  # iteration whose affinity is clustered, and where the linkage stops
MANY_VIEWS = 8  # with more than this, one start will do

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def soft_starts(table: RowTable) -> list[Ints]:
    """One or, with few views, two partitions (D,) to start the search from; clusters in [0, K)."""
    history = em_affinities(table)
    partitions = []
    for iteration, stop in STARTS[: 1 if table.num_views > MANY_VIEWS else None]:
        graph = ViewGraph(history[iteration].astype(np.float64), table.view_index, table.num_views)
        partitions.append(link_average(graph, stop))
    return partitions


def em_affinities(table: RowTable) -> list[NDArray[np.floating]]:
    """How likely two regions are one instance, from the rows alone, by expectation maximisation.

    E step: the rows of a pixel share one unit of belief by a soft maximum of their mean affinity between all regions
    that they name (the pixel's own included), less EMPTY_COST for views that show nothing. With many views, EM_VIEWS of
    them are compared with each other. M step: the affinity of region n to m is the belief in rows with m, averaged over
    the pixels of n, and made symmetric.

    Args:
        table: rows of D regions.

    Returns:
        The affinity after each iteration: (D, D) float32 in [0, 1], symmetric, 0 within a view.
    """
    num = len(table.view_index)
    is_used = _spread_pixels(table)
    rows = np.flatnonzero(is_used[table.pixel])
    start = run_starts(table.pixel[rows])
    if not len(start):
        return [np.zeros((num, num), np.float32)] * len(SHARPNESS)
    num_pixels = np.maximum(np.bincount(table.pixel_region[is_used], minlength=num), 1).astype(np.float32)[:, None]
    run_lengths = np.diff(np.append(start, len(rows)))
    blocks = [_compare_views(table, rows[block]) for block in blocks_of_runs(start, len(rows))]
    affinity = _symmetric(_count_shown(table, rows, start) / num_pixels)
    history = []
    for beta in SHARPNESS:
        score = np.concatenate([block.scores(affinity) for block in blocks])
        best = np.maximum.reduceat(score, start)
        belief = np.exp(beta * (score - np.repeat(best, run_lengths))).astype(np.float64)
        belief /= np.repeat(np.add.reduceat(belief, start), run_lengths)
        is_believed = belief > NEGLIGIBLE
        affinity = _symmetric(_share_belief(table, rows[is_believed], belief[is_believed]) / num_pixels)
        history.append(affinity)
    return history


def _symmetric(A: Floats) -> Floats:
    mean: Floats = (A + A.T) / np.float32(2)
    return mean


def _spread_pixels(table: RowTable) -> NDArray[np.bool_]:
    """(Q,) the pixels that EM uses: at most EM_PIXELS of each region, fewer with many views."""
    most = max(1, round(EM_PIXELS * min(1, PLENTY / table.num_views)))
    counts = np.bincount(table.pixel_region, minlength=len(table.view_index))
    rank = np.arange(len(table.pixel_region)) - np.searchsorted(table.pixel_region, table.pixel_region)
    is_used: NDArray[np.bool_] = rank % np.maximum(1, -(-counts // most))[table.pixel_region] == 0
    return is_used


@dataclass(frozen=True, eq=False)
class _ComparedRows:
    """R rows and the regions whose affinity to each other says how likely each row is.

    Attributes:
        labels: (N, R) int64, the regions of each row, the pixel's own first; rows with the most regions first.
        num_labels: (R,) how many of the N entries hold a region.
        order: (R,) the place of each row in the table's order.
        num_empty: (R,) compared views that show no region.
        num_inside: (R,) compared views that the point lies in.
    """

    labels: Ints
    num_labels: Ints
    order: Ints
    num_empty: Ints
    num_inside: Ints

    def scores(self, affinity: Floats) -> Floats:
        """(R,) float32, in the table's order: mean affinity (D, D) of the regions, less what empty views cost."""
        flat, num = affinity.ravel(), len(affinity)
        total = np.zeros(len(self.order), np.float32)
        for index in range(1, len(self.labels)):
            stop = int(np.searchsorted(-self.num_labels, -index))  # rows with more labels than `index`
            cell = self.labels[index, :stop] * num + self.labels[:index, :stop]
            total[:stop] += np.take(flat, cell).sum(0)
        pairs = np.maximum(self.num_inside * (self.num_inside + 1), 1)
        score = np.empty_like(total)
        score[self.order] = 2 * total / pairs - EMPTY_COST * self.num_empty / np.maximum(self.num_inside, 1)
        return score


def _compare_views(table: RowTable, rows: Ints) -> _ComparedRows:
    """The rows, with what EM_VIEWS views show at most; those are spread evenly, starting with the pixel's own."""
    num, owner = len(table.view_index), table.pixel_region[table.pixel[rows]]
    labels = table.labels[rows]
    if table.num_views > EM_VIEWS:
        steps = np.arange(EM_VIEWS) * table.num_views // EM_VIEWS
        labels = np.take_along_axis(labels, (table.view_index[owner][:, None] + steps) % table.num_views, 1)
    named = np.where(labels < 0, num, labels).astype(np.int64)
    named = np.column_stack((owner, np.sort(named, 1)))
    num_labels = (named < num).sum(1)
    order = np.argsort(-num_labels, kind="stable")
    return _ComparedRows(
        labels=np.ascontiguousarray(named[order, : int(num_labels.max())].T),
        num_labels=num_labels[order],
        order=order,
        num_empty=(labels == EMPTY).sum(1)[order],
        num_inside=(labels >= EMPTY).sum(1)[order],
    )


def _count_shown(table: RowTable, rows: Ints, start: Ints) -> Floats:
    """(D, D) float32: on the rays of how many pixels of the first region some row names the second."""
    num = len(table.view_index)
    shown = np.zeros((num, num), np.float32)
    for block in blocks_of_runs(start, len(rows)):
        here = table.labels[rows[block]].astype(np.int64)
        first = run_starts(table.pixel[rows[block]])
        run = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(here))))
        is_shown = np.zeros((len(first), num + 1), bool)  # the last column collects what is no region
        is_shown[run[:, None], np.maximum(here, -1)] = True
        owner = table.pixel_region[table.pixel[rows[block]][first]]
        begin = run_starts(owner)
        shown[owner[begin]] += np.add.reduceat(is_shown[:, :num], begin, 0, dtype=np.float32)
    return shown


def _share_belief(table: RowTable, rows: Ints, belief: Floats) -> Floats:
    """(D, D) float32: the summed belief in rows on rays of the first region that name the second."""
    num = len(table.view_index)
    mass = np.zeros((num, num), np.float32)
    for begin in range(0, len(rows), BLOCK_ROWS):
        block = rows[begin : begin + BLOCK_ROWS]
        owner = table.pixel_region[table.pixel[block]]
        low, high = int(owner[0]), int(owner[-1]) + 1
        cell = ((owner - low) * (num + 1))[:, None] + np.where(table.labels[block] < 0, num, table.labels[block])
        weight = np.broadcast_to(belief[begin : begin + BLOCK_ROWS, None], cell.shape)
        local = np.bincount(cell.ravel(), weight.ravel(), (high - low) * (num + 1))
        mass[low:high] += local.reshape(high - low, num + 1)[:, :num]
    return mass
