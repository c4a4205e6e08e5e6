"""What a person knows of masks: that they show one leaf, or different ones. Not in the paper.

Masks that must be together are one node of the graph. Where the views have put them into several clusters, the node
joins those clusters that it fits: a mask that was matched wrongly leaves its cluster, and halves of a leaf come
together. A cluster with masks that cannot be together falls apart by average linkage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from mvseg.errors import InputError
from mvseg.matching.one_per_view import FORBIDDEN, STOP, TIE, ViewGraph
from mvseg.matching.partition import renumber

HALF = 0.5  # share of a cluster's own mean weight, from which linked masks fit it
SECOND_CHANCE = 0.4  # mean weight from which a mask that was taken out of a cluster joins another one
MORE_FORBIDDEN = 1e6 * FORBIDDEN

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Links:
    """Pairs of D regions. Their order, and that within a pair, does not matter.

    Attributes:
        must: (P, 2) int64, regions that show one instance.
        cannot: (Q, 2) int64, regions that show different ones.
    """

    must: Tensor
    cannot: Tensor

    @staticmethod
    def of(must: list[tuple[int, int]] | None = None, cannot: list[tuple[int, int]] | None = None) -> Links:
        """Links from lists of pairs."""
        return Links(*(torch.tensor(pairs or [], dtype=torch.int64).reshape(-1, 2) for pairs in (must, cannot)))

    def __len__(self) -> int:
        return len(self.must) + len(self.cannot)

    def select(self, rows: Tensor) -> Links:
        """The links among the regions `rows` (N,) int64, by their places there."""
        most = 1 + max(int(each.max()) if each.numel() else -1 for each in (self.must, self.cannot, rows))
        place = torch.full((most,), -1, dtype=torch.int64)
        place[rows.cpu()] = torch.arange(len(rows))
        must, cannot = place[self.must.cpu()], place[self.cannot.cpu()]
        return Links(must[(must >= 0).all(1)], cannot[(cannot >= 0).all(1)])

    def components(self, num_regions: int) -> Ints:
        """(D,) number of the regions that must be together, transitively.

        Raises:
            InputError: a region that is not there, or two that must and cannot be together.
        """
        pairs, apart = self.must.cpu().numpy(), self.cannot.cpu().numpy()
        for region in np.concatenate((pairs.ravel(), apart.ravel())).tolist():
            if not 0 <= region < num_regions:
                raise InputError(f"a link names region {region}, expected one of 0 to {num_regions - 1}")
        edges = coo_array((np.ones(len(pairs)), pairs.T), shape=(num_regions, num_regions))
        component = renumber(connected_components(edges, directed=False)[1].astype(np.int64))
        both = np.flatnonzero(component[apart[:, 0]] == component[apart[:, 1]])
        if len(both):
            first, second = apart[both[0]].tolist()
            raise InputError(f"links say that regions {first} and {second} are the same and that they are different")
        return component


def keep_links(clusters: Ints, graph: ViewGraph, links: Links) -> Ints:
    """The partition, changed where it contradicts links; one that agrees with all of them stays as it is.

    Args:
        clusters: (D,) cluster of each region, from 0 on.
        graph: their epipolar weights.
        links: of the regions.

    Returns:
        (D,) clusters, numbered by their first region. The order of the links does not matter.

    Raises:
        InputError: links that contradict each other.
    """
    if not len(links):
        return clusters
    component = links.components(len(clusters))
    joined = clusters.copy()
    for number in np.flatnonzero(np.bincount(component) > 1).tolist():
        node = component == number
        if len(np.unique(joined[node])) > 1:
            joined = _join_node(joined, graph, node)
    pairs = np.unique(np.sort(links.cannot.cpu().numpy(), 1), axis=0)
    apart = np.zeros((int(component.max(initial=-1)) + 1,) * 2, bool)
    apart[component[pairs[:, 0]], component[pairs[:, 1]]] = True
    is_apart = (apart | apart.T)[component][:, component]
    divided = joined
    for first, second in pairs.tolist():
        if divided[first] == divided[second]:
            divided = _divide(divided, graph, component, is_apart=is_apart, pair=(first, second))
    torn = pairs[joined[pairs[:, 0]] == joined[pairs[:, 1]]]
    for region in np.unique(torn).tolist():
        if (divided == divided[region]).sum() == 1:
            divided = _second_chance(divided, graph, region, forbidden=is_apart[region])
    return renumber(divided)


def _join_node(clusters: Ints, graph: ViewGraph, node: NDArray[np.bool_]) -> Ints:
    """The regions of `node` (D,) bool leave their clusters, and join all of these that they fit as one region."""
    joined = clusters.copy()
    joined[node] = clusters.max() + 1
    for number in np.unique(clusters[node]).tolist():
        rest = np.flatnonzero((clusters == number) & ~node)
        if not len(rest):
            continue
        views = graph.view_index[rest]
        to_node = graph.weights[np.ix_(rest, node)].max(1)
        is_elsewhere = (graph.view_index[node] != views[:, None]).any(1)
        within, is_pair = graph.weights[np.ix_(rest, rest)], views[:, None] != views
        own = within[is_pair].mean() if is_pair.any() else 0.0
        if is_elsewhere.any() and to_node[is_elsewhere].mean() >= max(STOP, HALF * own):
            joined[rest] = joined[node][0]
    return joined


def _divide(
    clusters: Ints, graph: ViewGraph, component: Ints, *, is_apart: NDArray[np.bool_], pair: tuple[int, int]
) -> Ints:
    """The cluster of two regions in two: average linkage in which components are one, and `is_apart` (D, D) is never
    joined before the last step."""
    members = np.flatnonzero(clusters == clusters[pair[0]])
    first, second = (members[index] for index in np.triu_indices(len(members), 1))
    farthest = graph.weights.max(initial=1.0)
    distance = 1 + farthest - graph.weights[first, second] + TIE * np.linspace(0, 1, len(first))
    distance[component[first] == component[second]] = 0
    distance[is_apart[first, second]] = FORBIDDEN
    low, high = sorted(component[list(pair)].tolist())
    ends = np.sort(component[np.stack((first, second))], 0)
    distance[(ends[0] == low) & (ends[1] == high)] = MORE_FORBIDDEN  # any merge of these two is the last
    side = fcluster(linkage(distance, "average"), 2, "maxclust")
    divided = clusters.copy()
    divided[members[side != side[members == pair[0]]]] = clusters.max() + 1
    return divided


def _second_chance(clusters: Ints, graph: ViewGraph, region: int, *, forbidden: NDArray[np.bool_]) -> Ints:
    """A region that is alone joins the cluster of largest mean weight that has no region in its view and none that is
    `forbidden` (D,)."""
    clusters = renumber(clusters)
    taken = np.unique(clusters[forbidden | (graph.view_index == graph.view_index[region])])
    mean = np.bincount(clusters, graph.weights[region]) / np.bincount(clusters)
    mean[taken] = -1
    if mean.max() >= SECOND_CHANCE:
        clusters[region] = mean.argmax()
    return clusters
