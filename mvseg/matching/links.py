"""Links of the user between masks: they show one leaf, or different ones. Not in the paper.

Masks that must be together are one node of the graph, and those that cannot never join one cluster: the search itself
honours both (`ViewGraph`), so that a link pulls the rest of its leaf.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from mvseg.arrays import Ints
from mvseg.errors import InputError
from mvseg.matching.partition import Clusters


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

    def named(self, num_regions: int) -> Tensor:
        """(D,) bool, the regions that some link names."""
        is_named = torch.zeros(num_regions, dtype=torch.bool)
        is_named[torch.cat((self.must, self.cannot)).flatten()] = True
        return is_named

    def agree(self, clusters: Clusters) -> bool:
        """Whether clusters of the D regions say the same."""
        must, cannot = clusters.ids[self.must.cpu().numpy()], clusters.ids[self.cannot.cpu().numpy()]
        is_together = [(pairs[:, 0] == pairs[:, 1]) & (pairs[:, 0] >= 0) for pairs in (must, cannot)]
        return bool(is_together[0].all() and not is_together[1].any())

    def components(self, num_regions: int) -> Ints:
        """(D,) number of the regions that must be together, transitively. Raises InputError: a region that is not
        there, or two that must and cannot be together."""
        pairs, apart = self.must.cpu().numpy(), self.cannot.cpu().numpy()
        for region in np.concatenate((pairs.ravel(), apart.ravel())).tolist():
            if not 0 <= region < num_regions:
                raise InputError(f"a link names region {region}, expected one of 0 to {num_regions - 1}")
        edges = coo_array((np.ones(len(pairs)), pairs.T), shape=(num_regions, num_regions))
        component = Clusters.of(connected_components(edges, directed=False)[1]).ids
        both = np.flatnonzero(component[apart[:, 0]] == component[apart[:, 1]])
        if len(both):
            first, second = apart[both[0]].tolist()
            raise InputError(f"links say that regions {first} and {second} are the same and that they are different")
        return component


NO_LINKS = Links.of()
