"""The search for the partition that explains all views best.

Each start is refined by one assignment problem per view, as in `one_per_view.py`, but decided by how well the clusters
explain the regions in all views. A remaining region may join a cluster that has a region in its view already, if the
cluster covers it too: fragments of an instance that the segmenter or a stem in front of it divides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Ints, Reals
from mvseg.matching.numbers import GAINS, PIECES, SEARCH
from mvseg.matching.nview.cluster_scores import ClusterScores, ViewGains
from mvseg.matching.nview.initialisation import initial_partitions
from mvseg.matching.one_per_view import assign_one_to_one, join_alone, view_order
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import Movers
from mvseg.system.running import progress_bar


def search(scores: ClusterScores, pairwise: Clusters, *, more_starts: Sequence[Clusters] = ()) -> Clusters:
    """The best partition that refinement finds from one start, or, with few views, two. Links hold all the way.

    Clusters from the weights alone (`pairwise`, those of one region included, as in all partitions here) are kept when
    they are worth nearly as much: then the masks are sound, and the weights decide better about slivers that few views
    show. The scores are of three views or more; `more_starts` are partitions to start from as well.
    """
    starts = *initial_partitions(scores.sweep, scores.graph), *more_starts
    refined = [refine_clusters(scores, refine_clusters(scores, start), join_fragments=True) for start in starts]
    values = [scores.value(clusters) for clusters in (pairwise, *refined)]
    best = pairwise
    if max(values) - values[0] > (1 - SEARCH.as_good) * abs(max(values)):
        best = refined[int(np.argmax(values[1:]))]
        best = join_alone(scores.graph, best, stop=SEARCH.second_chance)
    return join_few(scores, best)


def refine_clusters(scores: ClusterScores, clusters: Clusters, *, join_fragments: bool = False) -> Clusters:
    """Re-assign the regions of one view after another to the clusters of the others, until nothing changes. With
    `join_fragments`, remaining regions may join a cluster that has a region in their view already."""
    order = view_order(scores.graph)
    for _ in range(SEARCH.max_sweeps):
        ids, coverages = clusters.ids.copy(), scores.coverages(clusters)
        for view in progress_bar(order.tolist(), name="choosing ids", unit="view"):
            movers = scores.graph.movers(view)
            if not movers.num:
                continue
            gains = _gains(scores, movers, ids, coverages)
            chosen = assign_one_to_one(gains.total, 0.0)
            if join_fragments:
                is_free = np.ones(movers.num, bool)
                is_free[movers.owner[scores.graph.apart[movers.rows].any(1)]] = False  # as the user says
                chosen = _join_fragments(chosen, gains, is_free=is_free)
            fresh = ids.max() + 1 + np.arange(len(chosen))
            ids[movers.rows] = np.append(gains.clusters, fresh)[chosen][movers.owner]
        before, clusters = clusters, Clusters.of(ids)
        if (clusters.ids == before.ids).all():
            break
    return clusters


def join_few(scores: ClusterScores, clusters: Clusters) -> Clusters:
    """Dissolve clusters that few views show into larger ones that cover their regions.

    Fragments of over-segmented masks, and merged masks, find each other across views and form spurious instances. A
    region of such a cluster joins the larger one that covers most of it and explains some of it, if there is one,
    whether or not that one has a region in the view already. Linked regions stay, and all with fewer than four views.
    """
    sweep = scores.sweep
    is_shown = np.zeros((len(clusters), sweep.num_views), bool)
    is_shown[clusters.ids, sweep.view_index] = True
    is_few = is_shown.sum(1) <= max(1, PIECES.few * sweep.num_views)
    if sweep.num_views < 4 or not is_few.any():
        return clusters
    coverages, joined, is_linked = scores.coverages(clusters), clusters.ids.copy(), scores.graph.is_linked
    for view in np.unique(sweep.view_index[is_few[clusters.ids]]).tolist():
        here = sweep.regions_of[view]
        gains = scores.gains(view, clusters.ids, coverages)
        fits = ~is_few[gains.clusters] & (gains.coverage >= PIECES.few_covered) & (gains.score > 0)
        moves = is_few[clusters.ids[here]] & fits.any(1) & ~is_linked[here]
        if moves.any():
            joined[here][moves] = gains.clusters[np.where(fits, gains.coverage, -1)[moves].argmax(1)]
    return Clusters.of(joined)


def _gains(scores: ClusterScores, movers: Movers, ids: Ints, coverages: Reals) -> ViewGains:
    """Gains of the movers from joining the other regions' clusters, summed over nodes; -inf where they cannot."""
    graph, rest = scores.graph, ids.copy()
    rest[movers.rows] = -1
    numbers = np.unique(rest[rest >= 0])
    shape = len(movers.rows), len(numbers)
    score, coverage, total = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape)
    for view in np.unique(graph.view_index[movers.rows]).tolist():
        gains = scores.gains(view, rest, coverages)
        here, place = graph.view_index[movers.rows] == view, np.searchsorted(numbers, gains.clusters)
        own = movers.rows[here] - scores.sweep.regions_of[view].start
        for to, values in ((score, gains.score), (coverage, gains.coverage), (total, gains.total)):
            to[np.ix_(here, place)] = values[own]
    sums = movers.total(total)
    sums[graph.forbidden(movers, ids, numbers)] = -np.inf
    sizes = movers.sizes[:, None].astype(np.float32)
    return ViewGains(numbers, movers.total(score) / sizes, movers.total(coverage) / sizes, sums)


def _join_fragments(chosen: Ints, gains: ViewGains, *, is_free: NDArray[np.bool_]) -> Ints:
    is_assigned = chosen < len(gains.clusters)
    holder_score = np.full(len(gains.clusters), np.inf)
    holder_score[chosen[is_assigned]] = gains.score[is_assigned, chosen[is_assigned]]
    fits = (gains.coverage >= PIECES.covered) & (gains.score > 0)
    fits &= gains.score >= PIECES.as_good * holder_score
    value = np.where(fits, gains.score + GAINS.coverage * gains.coverage, -np.inf)
    joins = ~is_assigned & is_free & fits.any(1)
    chosen = chosen.copy()
    if joins.any():
        chosen[joins] = value[joins].argmax(1)
    return chosen
