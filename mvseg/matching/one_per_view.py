"""Stage 5a: clusters with at most one region per view, from the epipolar weights alone.

An instance has one mask in a view. SymNMF cannot know that; agglomeration that never joins two regions of one view, and
then one assignment problem per view (permutation synchronisation by projected power iteration, Chen and Candes 2016,
with the Hungarian method as the projection), can. The number of clusters comes out by itself.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from mvseg.matching.affinity import Affinity
from mvseg.matching.symnmf import renumber

STOP = 0.2  # mean weight below which two clusters are not joined
ALONE = 0.1  # what it is worth to a region to be in no cluster, in units of the mean weight to a cluster's V - 1 others
MAX_SWEEPS = 20

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def one_per_view_clusters(affinity: Affinity, view_index: Tensor, num_views: int) -> Tensor:
    """Cluster the graph so that no cluster holds two regions of one view.

    Average-linkage agglomeration, then sweeps of one assignment problem per view until nothing changes.

    Args:
        affinity: the graph of D regions.
        view_index: (D,) int64 in [0, V), the view of each region.
        num_views: V.

    Returns:
        (D,) int64 in [0, K), clusters numbered in the order of their first region; -1 for a region that is alone in its
        cluster. The partition does not depend on the order of views and regions unless weights tie.
    """
    W = affinity.to_dense().cpu().double().numpy()
    views = view_index.cpu().numpy()
    ids = power_iteration(W, views, num_views, link_average(W, views, num_views))
    return renumber(drop_singletons(ids)).to(view_index.device)


def link_average(W: Floats, views: Ints, num_views: int, stop: float = STOP) -> Ints:
    """Average linkage under the constraint that clusters that share a view are never joined.

    Args:
        W: (D, D) symmetric weights >= 0.
        views: (D,) view of each region.
        num_views: V.
        stop: no pair of clusters with a smaller mean weight is joined.

    Returns:
        (D,) cluster of each region, numbers with gaps.
    """
    num = len(W)
    ids = np.arange(num)
    if num < 2:
        return ids
    total, size = W.copy(), np.ones(num)
    has_view = np.zeros((num, num_views), bool)
    has_view[ids, views] = True
    mean = np.where(views[:, None] == views, -1.0, W)
    best = mean.max(1)
    while True:
        a = int(best.argmax())
        if best[a] < stop or best[a] <= 0:
            return ids
        b = int(mean[a].argmax())
        ids[ids == b] = a
        has_view[a] |= has_view[b]
        total[a] += total[b]
        total[:, a] = total[a]
        size[a] += size[b]
        size[b] = 0
        may_join = (size > 0) & ~(has_view & has_view[a]).any(1)
        row = np.where(may_join, total[a] / np.maximum(size[a] * size, 1), -1.0)
        stale = (mean[:, a] >= best) | (mean[:, b] >= best)
        mean[a], mean[:, a], mean[b], mean[:, b] = row, row, -1.0, -1.0
        best = np.maximum(best, row)
        stale[[a, b]] = True
        best[stale] = mean[stale].max(1)


def power_iteration(W: Floats, views: Ints, num_views: int, ids: Ints, alone: float = ALONE) -> Ints:
    """Re-assign the regions of one view after another to the clusters of the others, one to one.

    The gain of a region from a cluster is its summed weight to the members, divided by V - 1; a region may also stay
    alone, for a gain of `alone`. The views with the largest total weight come first, whatever their numbers.

    Returns:
        (D,) cluster of each region in [0, K), regions that stay alone included.
    """
    order = view_order(W, views, num_views)
    for _ in range(MAX_SWEEPS):
        before = dense_ids(ids)
        ids = before
        for view in order:
            here = np.flatnonzero(views == view)
            rest = np.where(views == view, -1, ids)
            kept, rest[rest >= 0] = np.unique(rest[rest >= 0], return_inverse=True)
            members = np.zeros((len(W), len(kept)))
            members[rest >= 0, rest[rest >= 0]] = 1
            gain = W[here] @ members / max(num_views - 1, 1)
            rest[here] = assign_one_to_one(gain, alone)
            ids = rest
        if (dense_ids(ids) == before).all():
            break
    return dense_ids(ids)


def join_alone(W: Floats, views: Ints, num_views: int, ids: Ints, stop: float) -> Ints:
    """Give regions that are alone a second chance by their weights only.

    They are linked with each other (average linkage), and those still alone join the cluster of largest mean weight
    that has no region of their view; never for a mean weight below `stop`. Other regions stay where they are.

    Returns:
        (D,) cluster of each region in [0, K).
    """
    ids = ids.copy()
    alone = np.flatnonzero(np.bincount(ids, minlength=1)[ids] == 1)
    linked = link_average(W[np.ix_(alone, alone)], views[alone], num_views, stop)
    ids[alone] = ids.max(initial=0) + 1 + linked
    for region in alone[np.argsort(-W[alone].max(1, initial=0), kind="stable")].tolist():
        ids = dense_ids(ids)
        sizes = np.bincount(ids)
        taken = np.unique(ids[views == views[region]])
        mean = np.bincount(ids, W[region]) / sizes
        mean[taken] = -1
        if sizes[ids[region]] == 1 and mean.max() >= stop:
            ids[region] = mean.argmax()
    return dense_ids(ids)


def assign_one_to_one(gain: Floats, alone: float) -> Ints:
    """Best assignment of N regions to K clusters: a cluster takes at most one, and any region may stay alone.

    Args:
        gain: (N, K).
        alone: gain of a region in a cluster of its own.

    Returns:
        (N,) cluster of each region; those alone get K, K + 1, ...
    """
    num_regions, num_clusters = gain.shape
    padded = np.full((num_regions, num_clusters + num_regions), alone)
    padded[:, :num_clusters] = gain
    region, cluster = linear_sum_assignment(padded, maximize=True)
    chosen = np.empty(num_regions, np.int64)
    chosen[region] = cluster
    is_alone = chosen >= num_clusters
    chosen[is_alone] = num_clusters + np.arange(is_alone.sum())
    return chosen


def view_order(W: Floats, views: Ints, num_views: int) -> Ints:
    """(V,) views by decreasing total weight of their regions: an order that does not depend on their numbers."""
    return np.argsort(-np.bincount(views, weights=W.sum(1), minlength=num_views), kind="stable")


def dense_ids(ids: Ints) -> Ints:
    """The same partition numbered from 0 in the order of the first members."""
    _, first, inverse = np.unique(ids, return_index=True, return_inverse=True)
    return first.argsort().argsort()[inverse].astype(np.int64)


def drop_singletons(ids: Ints) -> Tensor:
    """(D,) int64 ids >= 0 with -1 for the only member of its cluster."""
    sizes = np.bincount(ids, minlength=1)
    return torch.from_numpy(np.where(sizes[ids] > 1, ids, -1))
