"""Clusters with at most one region per view, from the epipolar weights alone.

An instance has one mask in a view, which SymNMF cannot know. Average linkage that never joins two regions of one view
uses it, and so does the assignment problem that is then solved for each view (permutation synchronisation by projected
power iteration, Chen and Candes 2016, with the Hungarian method as the projection). The number of clusters is a result.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import squareform

from mvseg.arrays import Ints, Reals
from mvseg.matching.numbers import ONE_PER_VIEW
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import ViewGraph


def one_per_view_clusters(graph: ViewGraph) -> Clusters:
    """Cluster the graph so that no cluster holds two regions of one view, but for regions that links join.

    Average linkage, then sweeps of one assignment problem per view until nothing changes. Clusters of one region are
    included. Only where weights tie does the result depend on the order of views and regions.
    """
    return power_iteration(graph, link_average(graph, ONE_PER_VIEW.stop))


def link_average(graph: ViewGraph, stop: float) -> Clusters:
    """Average linkage in which clusters that share a view, or are apart, are never joined; singletons are included.

    Nodes of several regions are joined first: from then on linkage is that of the contracted graph, whose weights are
    means. Of equal weights, that of the regions that come first counts as larger, so that SciPy's order of ties does
    not show. Clusters with a mean weight of 0, or below `stop`, are not joined.
    """
    if len(graph.weights) < 2:
        return Clusters.of(np.arange(len(graph.weights)))
    farthest = graph.weights.max(initial=1.0)  # the distance between two regions without an edge
    distances = farthest - graph.weights
    distances[graph.view_index[:, None] == graph.view_index] = ONE_PER_VIEW.forbidden
    distances[graph.apart] = ONE_PER_VIEW.forbidden
    distance = squareform(distances, checks=False)
    distance += ONE_PER_VIEW.tie * np.linspace(0, 1, len(distance))
    distance[squareform(graph.node[:, None] == graph.node, checks=False)] = 0
    cut = min(farthest - stop + ONE_PER_VIEW.tie, np.nextafter(farthest, 0))
    return Clusters.of(fcluster(linkage(distance, "average"), cut, "distance"))


def power_iteration(graph: ViewGraph, clusters: Clusters) -> Clusters:
    """Re-assign the regions of one view after another to the clusters of the others, one to one.

    The gain of a region from a cluster is its summed weight to the members, divided by V - 1; a region may also stay
    alone, for a gain of `ONE_PER_VIEW.alone`. A node of several regions moves as one, whenever a view of it is
    re-assigned; its gains are their sums. The views with the largest total weight come first, whatever their numbers.
    """
    order = view_order(graph)
    for _ in range(ONE_PER_VIEW.max_sweeps):
        before, ids = clusters.ids, clusters.ids
        for view in order:
            movers = graph.movers(view)
            rest = ids.copy()
            rest[movers.rows] = -1
            others = np.argsort(rest, kind="stable")[len(movers.rows) :]  # cluster by cluster
            start = np.flatnonzero(np.diff(rest[others], prepend=-1))
            numbers = rest[others[start]]
            weights = np.add.reduceat(graph.weights[movers.rows].take(others, 1), start, 1)
            gain = movers.total(weights) / max(graph.num_views - 1, 1)
            gain[graph.forbidden(movers, ids, numbers)] = -np.inf
            chosen = assign_one_to_one(gain, ONE_PER_VIEW.alone * movers.sizes)
            fresh = ids.max(initial=-1) + 1 + np.arange(movers.num)
            rest[movers.rows] = np.append(numbers, fresh)[chosen][movers.owner]
            ids = rest
        clusters = Clusters.of(ids)
        if (clusters.ids == before).all():
            break
    return clusters


def join_alone(graph: ViewGraph, clusters: Clusters, *, stop: float) -> Clusters:
    """Give regions that are alone a second chance, judged by weights only.

    They are linked with each other (average linkage); those still alone join the cluster of largest mean weight that
    has no region in their view. Nothing is joined at a mean weight below `stop`. Other regions stay where they are.
    """
    ids, alone = clusters.ids.copy(), np.flatnonzero(clusters.is_alone)
    ids[alone] = len(clusters) + link_average(graph.select(alone), stop).ids
    best_weight = graph.weights[alone].max(1, initial=0)
    for region in alone[np.argsort(-best_weight, kind="stable")].tolist():
        clusters = Clusters.of(ids)
        ids = clusters.ids.copy()
        mean = np.bincount(ids, graph.weights[region]) / clusters.sizes
        mean[ids[(graph.view_index == graph.view_index[region]) | graph.apart[region]]] = -1
        if clusters.is_alone[region] and mean.max() >= stop:
            ids[region] = mean.argmax()
    return Clusters.of(ids)


def assign_one_to_one(gain: Reals, alone: float | Reals) -> Ints:
    """Assign N regions to K clusters by `gain` (N, K), -inf for never: a cluster takes at most one, and any region may
    stay alone for a gain of `alone`, one for all or (N,). Returns (N,) clusters; regions alone get K, K + 1, ..."""
    num_regions, num_clusters = gain.shape
    padded = np.full((num_regions, num_clusters + num_regions), np.reshape(alone, (-1, 1)))
    padded[:, :num_clusters] = gain
    region, cluster = linear_sum_assignment(padded, maximize=True)
    chosen = np.empty(num_regions, np.int64)
    chosen[region] = cluster
    is_alone = chosen >= num_clusters
    chosen[is_alone] = num_clusters + np.arange(is_alone.sum())
    return chosen


def view_order(graph: ViewGraph) -> Ints:
    """(V,) views by decreasing total weight of their regions: an order that does not depend on their numbers."""
    totals = np.bincount(graph.view_index, weights=graph.weights.sum(1), minlength=graph.num_views)
    return np.argsort(-totals, kind="stable")
