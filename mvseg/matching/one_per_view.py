"""Clusters with at most one region per view, from the epipolar weights alone.

An instance has one mask in a view, which SymNMF cannot know. Average linkage that never joins two regions of one view
uses it, and so does the assignment problem that is then solved for each view (permutation synchronisation by projected
power iteration, Chen and Candes 2016, with the Hungarian method as the projection). The number of clusters is a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import squareform
from torch import Tensor

from mvseg.matching.affinity import Affinity
from mvseg.matching.partition import drop_singletons, members_of, number_instances, renumber

STOP = 0.2  # mean weight below which two clusters are not joined
ALONE = 0.1  # gain of a region that stays alone, comparable to its mean weight to the V - 1 other views
MAX_SWEEPS = 20
TIE = 1e-9  # what equal weights differ by: less than two float32 weights do that differ at all
FORBIDDEN = 1e9  # distance between two regions of one view: a mean that includes it is never small enough

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """A graph of D regions as a matrix, with the view of each region.

    Attributes:
        weights: (D, D) symmetric, >= 0.
        view_index: (D,) int64 in [0, V).
        num_views: V.
        node: (D,) int64: regions with one number stay together, as a person says; None: each is by itself.
        apart: (D, D) bool, symmetric: regions that are never together; None: there are none.
    """

    weights: Floats
    view_index: Ints
    num_views: int
    node: Ints | None = None
    apart: NDArray[np.bool_] | None = None

    @staticmethod
    def of(affinity: Affinity, view_index: Tensor, num_views: int) -> ViewGraph:
        """The graph of D regions, nothing known of them; `view_index` (D,) int64."""
        weights = np.zeros((affinity.num_regions, affinity.num_regions))
        first, second = affinity.edges.T.cpu().numpy()
        weights[first, second] = weights[second, first] = affinity.weights.cpu().numpy()
        return ViewGraph(weights, view_index.cpu().numpy(), num_views)

    def select(self, index: Ints) -> ViewGraph:
        """The graph of some regions."""
        node = None if self.node is None else self.node[index]
        apart = None if self.apart is None else self.apart[np.ix_(index, index)]
        return ViewGraph(self.weights[np.ix_(index, index)], self.view_index[index], self.num_views, node, apart)

    def sum_partners(self, values: Floats, clusters: Ints) -> NDArray[np.float64]:
        """(D,) sums of `values` (D, D) between each region and its partners: the members of its cluster (D,) in other
        views; clusters in [0, K)."""
        sums = np.zeros(len(clusters))
        for members in members_of(clusters):
            is_partner = self.view_index[members][:, None] != self.view_index[members]
            sums[members] = (values[np.ix_(members, members)] * is_partner).sum(1)
        return sums

    @property
    def is_linked(self) -> NDArray[np.bool_]:
        """(D,) whether a person says anything of a region."""
        if self.node is None or self.apart is None:
            return np.zeros(len(self.view_index), bool)
        return self.is_joined | self.apart.any(1)

    @property
    def is_joined(self) -> NDArray[np.bool_]:
        """(D,) whether a person says of a region that it stays with another one."""
        if self.node is None:
            return np.zeros(len(self.view_index), bool)
        is_joined: NDArray[np.bool_] = np.bincount(self.node)[self.node] > 1
        return is_joined

    def movers(self, view: int) -> Movers:
        """The nodes that a view shows."""
        here = self.view_index == view
        if self.node is None:
            return Movers(np.flatnonzero(here), np.arange(int(here.sum())))
        rows = np.flatnonzero(np.isin(self.node, self.node[here]))
        _, first, owner = np.unique(self.node[rows], return_index=True, return_inverse=True)
        return Movers(rows, np.argsort(np.argsort(first))[owner])

    def forbidden(self, movers: Movers, clusters: Ints, numbers: Ints) -> NDArray[np.bool_]:
        """(N, K) bool: the clusters `numbers` (K,) that each mover cannot join: the others hold a region that it is
        apart from, or, but for the cluster (D,) that it is in, one in its view."""
        is_forbidden = np.zeros((movers.num, len(numbers)), bool)
        if self.node is None or self.apart is None:
            return is_forbidden
        stays = np.ones(len(clusters), bool)
        stays[movers.rows] = False
        members = (clusters[:, None] == numbers) & stays[:, None]
        same_view = self.view_index[movers.rows][:, None] == self.view_index
        is_elsewhere = clusters[movers.rows][:, None] != numbers
        conflicts = (self.apart[movers.rows] @ members) | ((same_view @ members) & is_elsewhere)
        np.logical_or.at(is_forbidden, movers.owner, conflicts)
        return is_forbidden


@dataclass(frozen=True, eq=False)
class Movers:
    """N nodes of regions, each of which moves as one.

    Attributes:
        rows: (R,) int64, their regions.
        owner: (R,) int64 in [0, N), the node of each.
    """

    rows: Ints
    owner: Ints

    @property
    def num(self) -> int:
        """N."""
        return int(self.owner.max(initial=-1)) + 1

    @property
    def sizes(self) -> Ints:
        """(N,) regions of each."""
        return np.bincount(self.owner, minlength=self.num)

    def total(self, values: Floats) -> Floats:
        """(N, K) sums over the regions of each node; `values` (R, K)."""
        summed = np.zeros((self.num, values.shape[1]), values.dtype)
        np.add.at(summed, self.owner, values)
        return summed


def one_per_view_clusters(affinity: Affinity, view_index: Tensor, num_views: int) -> Tensor:
    """Cluster the graph so that no cluster holds two regions of one view.

    Average linkage, then sweeps of one assignment problem per view until nothing changes.

    Args:
        affinity: the graph of D regions.
        view_index: (D,) int64 in [0, V), the view of each region.
        num_views: V.

    Returns:
        (D,) int64 instance ids in [1, K], numbered in the order of their first region; -1 for a region that is alone in
        its cluster. The partition does not depend on the order of views and regions unless weights tie.
    """
    return cluster_graph(ViewGraph.of(affinity, view_index, num_views)).to(view_index.device)


def cluster_graph(graph: ViewGraph) -> Tensor:
    """(D,) int64 instance ids on the CPU, see `one_per_view_clusters`; nodes of the graph are one region each."""
    return number_instances(drop_singletons(power_iteration(graph, link_average(graph))))


def link_average(graph: ViewGraph, stop: float = STOP) -> Ints:
    """Average linkage in which clusters that share a view are never joined, nor those that are apart.

    Nodes of several regions are joined first: from then on linkage is that of the contracted graph, whose weights are
    means. Of equal weights, that of the regions that come first counts as larger, so that SciPy's order of ties does
    not show.

    Args:
        graph: of D regions.
        stop: two clusters with a smaller mean weight, or with mean weight 0, are not joined.

    Returns:
        (D,) cluster of each region in [0, K), numbered by their first region.
    """
    if len(graph.weights) < 2:
        return np.arange(len(graph.weights))
    farthest = graph.weights.max(initial=1.0)  # the distance between two regions without an edge
    distances = farthest - graph.weights
    distances[graph.view_index[:, None] == graph.view_index] = FORBIDDEN
    if graph.apart is not None:
        distances[graph.apart] = FORBIDDEN
    distance = squareform(distances, checks=False)
    distance += TIE * np.linspace(0, 1, len(distance))
    if graph.node is not None:
        distance[squareform(graph.node[:, None] == graph.node, checks=False)] = 0
    cut = min(farthest - stop + TIE, np.nextafter(farthest, 0))
    return renumber(fcluster(linkage(distance, "average"), cut, "distance").astype(np.int64))


def power_iteration(graph: ViewGraph, clusters: Ints) -> Ints:
    """Re-assign the regions of one view after another to the clusters of the others, one to one.

    The gain of a region from a cluster is its summed weight to the members, divided by V - 1; a region may also stay
    alone, for a gain of ALONE. A node of several regions moves as one, whenever a view of it is re-assigned; its gains
    are their sums. The views with the largest total weight come first, whatever their numbers.

    Returns:
        (D,) cluster of each region in [0, K), regions that stay alone included.
    """
    order, clusters = view_order(graph), renumber(clusters)
    for _ in range(MAX_SWEEPS):
        before = clusters
        for view in order:
            movers = graph.movers(view)
            rest = clusters.copy()
            rest[movers.rows] = -1
            others = np.argsort(rest, kind="stable")[len(movers.rows) :]  # cluster by cluster
            start = np.flatnonzero(np.diff(rest[others], prepend=-1))
            numbers = rest[others[start]]
            weights = np.add.reduceat(graph.weights[movers.rows].take(others, 1), start, 1)
            gain = movers.total(weights) / max(graph.num_views - 1, 1)
            gain[graph.forbidden(movers, clusters, numbers)] = -np.inf
            chosen = assign_one_to_one(gain, ALONE * movers.sizes)
            fresh = clusters.max(initial=-1) + 1 + np.arange(movers.num)
            rest[movers.rows] = np.append(numbers, fresh)[chosen][movers.owner]
            clusters = rest
        clusters = renumber(clusters)
        if (clusters == before).all():
            break
    return clusters


def join_alone(graph: ViewGraph, clusters: Ints, *, stop: float) -> Ints:
    """Give regions that are alone a second chance, judged by weights only.

    They are linked with each other (average linkage); those still alone join the cluster of largest mean weight that
    has no region in their view. Nothing is joined at a mean weight below `stop`. Other regions stay where they are.

    Returns:
        (D,) cluster of each region in [0, K).
    """
    clusters = clusters.copy()
    alone = np.flatnonzero(np.bincount(clusters, minlength=1)[clusters] == 1)
    clusters[alone] = clusters.max(initial=0) + 1 + link_average(graph.select(alone), stop)
    best_weight = graph.weights[alone].max(1, initial=0)
    for region in alone[np.argsort(-best_weight, kind="stable")].tolist():
        clusters = renumber(clusters)
        sizes = np.bincount(clusters)
        is_apart = graph.view_index == graph.view_index[region]
        taken = np.unique(clusters[is_apart if graph.apart is None else is_apart | graph.apart[region]])
        mean = np.bincount(clusters, graph.weights[region]) / sizes
        mean[taken] = -1
        if sizes[clusters[region]] == 1 and mean.max() >= stop:
            clusters[region] = mean.argmax()
    return renumber(clusters)


def assign_one_to_one(gain: Floats, alone: float | Floats) -> Ints:
    """Best assignment of N regions to K clusters: a cluster takes at most one, and any region may stay alone.

    Args:
        gain: (N, K); -inf: never.
        alone: gain of a region in a cluster of its own; of all, or of each (N,).

    Returns:
        (N,) cluster of each region; those alone get K, K + 1, ...
    """
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
