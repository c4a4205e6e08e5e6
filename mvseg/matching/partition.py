"""Partitions of regions, numbered in one way.

A *cluster* number is an array index: 0, 1, ... in NumPy. An *instance id* is what users and files see: 1, 2, ..., in a
tensor, so that 0 can mean "nothing" in a label image. In both, -1 is a region that was matched to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Ints


@dataclass(frozen=True, eq=False)
class Clusters:
    """A partition of D regions into K clusters, made by `of`. `ids` (D,) int64 are clusters in [0, K), numbered in the
    order of their first members; -1 for a region in none."""

    ids: Ints

    @staticmethod
    def of(numbers: Ints) -> Clusters:
        """Regions with the same number (D,) form a cluster; those with a negative one are in none."""
        values, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        first = np.where(values < 0, -1, first)  # the unmatched rank before all clusters, and get -1
        rank = first.argsort(kind="stable").argsort(kind="stable") - int((values < 0).sum())
        return Clusters(np.maximum(rank, -1)[inverse].astype(np.int64))

    def __len__(self) -> int:
        """K."""
        return int(self.ids.max(initial=-1)) + 1

    @cached_property
    def members(self) -> list[Ints]:
        """The regions of each cluster, ascending."""
        return members_of(self.ids, len(self))

    @cached_property
    def sizes(self) -> Ints:
        """(K,) number of regions of each."""
        return np.bincount(self.ids[self.ids >= 0], minlength=len(self))

    @property
    def is_alone(self) -> NDArray[np.bool_]:
        """(D,) whether no other region is in the cluster of a region, or it is in none."""
        return np.asarray(np.append(self.sizes, 1)[self.ids] < 2)

    def drop_singletons(self) -> Clusters:
        """The same clusters but for those of one region."""
        return Clusters.of(np.where(self.is_alone, -1, self.ids))

    def instance_ids(self) -> Tensor:
        """(D,) int64 on the CPU, from 1 on; -1 stays -1."""
        return torch.from_numpy(np.where(self.ids < 0, -1, self.ids + 1))


def separate_unmatched(numbers: Ints) -> Ints:
    """(D,) the same numbers, with an unused one of its own for every region that has a negative one."""
    fresh = int(numbers.max(initial=-1)) + 1 + np.arange(len(numbers))
    return np.where(numbers < 0, fresh, numbers)


def members_of(numbers: Ints, num_clusters: int) -> list[Ints]:
    """The regions with the numbers 0 .. K - 1 (D,), ascending; an unused number has none, and -1 is left out."""
    order = np.argsort(numbers, kind="stable")
    starts = np.searchsorted(numbers[order], np.arange(num_clusters + 1))
    return [order[start:stop] for start, stop in pairwise(starts)]
