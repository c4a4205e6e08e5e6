"""Initial partitions of the search: soft multi-view stereo on region labels, before there is any cluster.

How likely two regions are one instance follows from which hypothesis of each ray is right, and the reverse: EM
estimates both. Average linkage of the affinity gives the clusters that the search refines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Ints, Reals
from mvseg.matching.numbers import EM, SWEEP
from mvseg.matching.nview.plane_sweep import EMPTY, PlaneSweep, blocks_of_runs, run_starts
from mvseg.matching.one_per_view import link_average
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import ViewGraph


def initial_partitions(sweep: PlaneSweep, graph: ViewGraph) -> list[Clusters]:
    """Start the search: one or, with few views, two partitions of D regions. Weights of the graph do not count."""
    history = em_affinities(sweep, graph)
    return [
        link_average(replace(graph, weights=history[iteration].astype(np.float64)), stop)
        for iteration, stop in EM.starts[: 1 if sweep.num_views > EM.many_views else None]
    ]


def em_affinities(sweep: PlaneSweep, graph: ViewGraph | None = None) -> list[NDArray[np.floating]]:
    """How likely two regions are one instance, from the hypotheses alone, by expectation maximisation.

    E step: the hypotheses of a pixel share one unit of belief by a soft maximum of their mean affinity between all
    regions that they name (the pixel's own included), less `EM.empty_cost` for views that show nothing. With many
    views, `EM.views` of them are compared with each other. M step: the affinity of region n to m is the belief in
    hypotheses with m, averaged over the pixels of n, and made symmetric. Links of the graph are 1 or 0 after each step:
    hypotheses that show linked regions are believed, and with them all else that these show. Its weights do not count.

    Returns:
        The affinity after each iteration: (D, D) float32 in [0, 1], symmetric, 0 within a view.
    """
    num = len(sweep.view_index)
    is_used = _spread_pixels(sweep)
    hypotheses = np.flatnonzero(is_used[sweep.pixel])
    start = run_starts(sweep.pixel[hypotheses])
    if not len(start):
        return [np.zeros((num, num), np.float32)] * len(EM.sharpness)
    num_pixels = np.maximum(np.bincount(sweep.pixel_region[is_used], minlength=num), 1).astype(np.float32)[:, None]
    run_lengths = np.diff(np.append(start, len(hypotheses)))
    blocks = [_compare_views(sweep, hypotheses[block]) for block in blocks_of_runs(start, len(hypotheses))]
    affinity = _symmetric(_count_shown(sweep, hypotheses, start) / num_pixels)
    history = []
    for beta in EM.sharpness:
        score = np.concatenate([block.scores(affinity) for block in blocks])
        best = np.maximum.reduceat(score, start)
        belief = np.exp(beta * (score - np.repeat(best, run_lengths))).astype(np.float64)
        belief /= np.repeat(np.add.reduceat(belief, start), run_lengths)
        is_believed = belief > EM.negligible
        affinity = _symmetric(_share_belief(sweep, hypotheses[is_believed], belief[is_believed]) / num_pixels)
        if graph is not None and len(graph.links):
            affinity[graph.apart] = 0
            affinity[(graph.node[:, None] == graph.node) & (sweep.view_index[:, None] != sweep.view_index)] = 1
        history.append(affinity)
    return history


def _symmetric(A: Reals) -> Reals:
    return np.asarray((A + A.T) / np.float32(2))


def _spread_pixels(sweep: PlaneSweep) -> NDArray[np.bool_]:
    most = max(1, round(EM.pixels * min(1, SWEEP.plenty / sweep.num_views)))
    counts = np.bincount(sweep.pixel_region, minlength=len(sweep.view_index))
    rank = np.arange(len(sweep.pixel_region)) - np.searchsorted(sweep.pixel_region, sweep.pixel_region)
    return np.asarray(rank % np.maximum(1, -(-counts // most))[sweep.pixel_region] == 0)


@dataclass(frozen=True, eq=False)
class _ComparedHypotheses:
    """R hypotheses and the regions whose affinity to each other says how likely each hypothesis is."""

    labels: Ints
    num_labels: Ints
    order: Ints
    num_empty: Ints
    num_inside: Ints

    def scores(self, affinity: Reals) -> Reals:
        """(R,) float32, in the sweep's order: mean affinity (D, D) of the regions, less what empty views cost."""
        flat, num = affinity.ravel(), len(affinity)
        total = np.zeros(len(self.order), np.float32)
        for index in range(1, len(self.labels)):
            stop = int(np.searchsorted(-self.num_labels, -index))  # hypotheses with more labels than `index`
            cell = self.labels[index, :stop] * num + self.labels[:index, :stop]
            total[:stop] += np.take(flat, cell).sum(0)
        pairs = np.maximum(self.num_inside * (self.num_inside + 1), 1)
        score = np.empty_like(total)
        score[self.order] = 2 * total / pairs - EM.empty_cost * self.num_empty / np.maximum(self.num_inside, 1)
        return score


def _compare_views(sweep: PlaneSweep, hypotheses: Ints) -> _ComparedHypotheses:
    """The hypotheses, with at most `EM.views` views, spread evenly, starting with the pixel's own."""
    num, owner = len(sweep.view_index), sweep.pixel_region[sweep.pixel[hypotheses]]
    labels = sweep.labels[hypotheses]
    if sweep.num_views > EM.views:
        steps = np.arange(EM.views) * sweep.num_views // EM.views
        labels = np.take_along_axis(labels, (sweep.view_index[owner][:, None] + steps) % sweep.num_views, 1)
    named = np.where(labels < 0, num, labels).astype(np.int64)
    named = np.column_stack((owner, np.sort(named, 1)))
    num_labels = (named < num).sum(1)
    order = np.argsort(-num_labels, kind="stable")
    named, num_labels = np.ascontiguousarray(named[order, : int(num_labels.max())].T), num_labels[order]
    empty, inside = (labels == EMPTY).sum(1)[order], (labels >= EMPTY).sum(1)[order]
    return _ComparedHypotheses(labels=named, num_labels=num_labels, order=order, num_empty=empty, num_inside=inside)


def _count_shown(sweep: PlaneSweep, hypotheses: Ints, start: Ints) -> Reals:
    """(D, D) float32: on the rays of how many pixels of the first region some hypothesis names the second."""
    num = len(sweep.view_index)
    counts = np.zeros((num, num), np.float32)
    for block in blocks_of_runs(start, len(hypotheses)):
        here = sweep.labels[hypotheses[block]].astype(np.int64)
        first = run_starts(sweep.pixel[hypotheses[block]])
        run = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(here))))
        is_shown = np.zeros((len(first), num + 1), bool)  # the last column collects what is no region
        is_shown[run[:, None], np.maximum(here, -1)] = True
        owner = sweep.pixel_region[sweep.pixel[hypotheses[block]][first]]
        begin = run_starts(owner)
        counts[owner[begin]] += np.add.reduceat(is_shown[:, :num], begin, 0, dtype=np.float32)
    return counts


def _share_belief(sweep: PlaneSweep, hypotheses: Ints, belief: Reals) -> Reals:
    """(D, D) float32: the summed belief in hypotheses on rays of the first region that name the second."""
    num = len(sweep.view_index)
    mass = np.zeros((num, num), np.float32)
    for begin in range(0, len(hypotheses), SWEEP.block_size):
        block = hypotheses[begin : begin + SWEEP.block_size]
        owner = sweep.pixel_region[sweep.pixel[block]]
        low, high = int(owner[0]), int(owner[-1]) + 1
        cell = ((owner - low) * (num + 1))[:, None] + np.where(sweep.labels[block] < 0, num, sweep.labels[block])
        weight = np.broadcast_to(belief[begin : begin + SWEEP.block_size, None], cell.shape)
        local = np.bincount(cell.ravel(), weight.ravel(), (high - low) * (num + 1))
        mass[low:high] += local.reshape(high - low, num + 1)[:, :num]
    return mass
