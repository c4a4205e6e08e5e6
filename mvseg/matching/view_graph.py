"""The graph that all methods cluster: epipolar weights, the views of the regions, and links of the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.arrays import Bools, Ints, Reals
from mvseg.matching.affinity import Affinity
from mvseg.matching.links import NO_LINKS, Links
from mvseg.matching.partition import Clusters
from mvseg.regions import Regions


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """A graph of D regions as a matrix, with the view of each region.

    Attributes:
        weights: (D, D) symmetric, >= 0.
        view_index: (D,) int64 in [0, V).
        links: regions that must stay together or apart.
    """

    weights: Reals
    view_index: Ints
    num_views: int
    links: Links = NO_LINKS

    @staticmethod
    def of(affinity: Affinity, regions: Regions, links: Links = NO_LINKS) -> ViewGraph:
        """The graph of D regions, with links that do not contradict each other (`Links.components`)."""
        weights = affinity.to_dense().double().cpu().numpy()
        return ViewGraph(weights, regions.view_index.cpu().numpy(), regions.num_views, links)

    def select(self, index: Ints) -> ViewGraph:
        """The graph of some regions, with the links among them."""
        links = self.links.select(torch.from_numpy(index))
        return ViewGraph(self.weights[np.ix_(index, index)], self.view_index[index], self.num_views, links)

    @cached_property
    def without_links(self) -> ViewGraph:
        """The same graph, nothing known of its regions."""
        return replace(self, links=NO_LINKS) if len(self.links) else self

    def sum_partners(self, values: Reals, clusters: Clusters) -> NDArray[np.float64]:
        """(D,) sums of `values` (D, D) between each region and its partners: its cluster's members in other views."""
        sums = np.zeros(len(clusters.ids))
        for members in clusters.members:
            is_partner = self.view_index[members][:, None] != self.view_index[members]
            sums[members] = (values[np.ix_(members, members)] * is_partner).sum(1)
        return sums

    @cached_property
    def node(self) -> Ints:
        """(D,) int64: regions with one number stay together."""
        return self.links.components(len(self.view_index))

    @cached_property
    def apart(self) -> Bools:
        """(D, D) symmetric: regions that are never together."""
        first, second = self.node[self.links.cannot.cpu().numpy()].T
        apart = np.zeros((int(self.node.max(initial=-1)) + 1,) * 2, bool)
        apart[first, second] = apart[second, first] = True
        return apart[self.node][:, self.node]

    @property
    def is_joined(self) -> Bools:
        """(D,) whether a region stays with another one."""
        return np.asarray(np.bincount(self.node, minlength=1)[self.node] > 1)

    @property
    def is_linked(self) -> Bools:
        """(D,) whether a link of the user names the region."""
        return self.is_joined | self.apart.any(1)

    def contract(self) -> Reals:
        """(N, N) symmetric, >= 0: the weights between nodes, so that SymNMF of them is that of all regions with links.

        With equal rows of H for the regions of one node, H = Q G. Q, 1 / sqrt(size) where a region is in a node, is
        orthonormal, so |W - H H^T|^2 is |Q^T W Q - G G^T|^2 and a constant. Nodes that are apart have weight 0.
        """
        if not len(self.links):
            return self.weights
        Q = np.eye(int(self.node.max()) + 1)[self.node]
        Q = Q / np.sqrt(Q.sum(0))
        return np.asarray(Q.T @ np.where(self.apart, 0, self.weights) @ Q)

    def part(self, clusters: Clusters) -> Clusters:
        """Clusters without contradictions to links. Nodes of several regions that are in none form one of their own;
        where nodes that are apart share one, those that fit it worst leave it for one of their own."""
        ids, weight = clusters.ids.copy(), self.sum_partners(self.weights, clusters)
        linked = np.flatnonzero(self.is_linked)
        for region in linked[np.argsort(weight[linked], kind="stable")]:
            is_own = self.node == self.node[region]
            is_in_none = ids[region] < 0 and is_own.sum() > 1
            if is_in_none or (ids[region] >= 0 and (ids[self.apart[region]] == ids[region]).any()):
                ids[is_own] = ids.max() + 1
        return Clusters.of(ids)

    def movers(self, view: int) -> Movers:
        """The nodes that a view shows."""
        rows = np.flatnonzero(np.isin(self.node, self.node[self.view_index == view]))
        _, first, owner = np.unique(self.node[rows], return_index=True, return_inverse=True)
        return Movers(rows, np.argsort(np.argsort(first))[owner])

    def forbidden(self, movers: Movers, clusters: Ints, numbers: Ints) -> Bools:
        """(N, K) bool: the clusters `numbers` (K,) that each mover cannot join. These hold a region that links keep
        apart from it, or a region of its view, unless it is in that cluster already."""
        is_forbidden = np.zeros((movers.num, len(numbers)), bool)
        if not len(self.links):
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
    """N nodes that move as one each: `rows` (R,) int64 are their regions, `owner` (R,) int64 in [0, N) the node of
    each."""

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

    def total(self, values: Reals) -> Reals:
        """(N, K) sums over the regions of each node; `values` (R, K)."""
        summed = np.zeros((self.num, values.shape[1]), values.dtype)
        np.add.at(summed, self.owner, values)
        return summed


def first_without_links(graph: ViewGraph, cluster: Callable[[ViewGraph, Clusters | None], Clusters]) -> Clusters:
    """Partition by a method. A partition without links that agrees with all of them is the best one under them, too.
    Otherwise the method runs with links, and gets the partition without them as its second argument."""
    found = cluster(graph.without_links, None)
    return found if graph.links.agree(found) else cluster(graph, found)
