"""Partitions of regions: what several rooms do with cluster numbers and instance ids.

A *cluster* number is an array index: 0, 1, ... in NumPy. An *instance id* is what users and files see: 1, 2, ..., in a
tensor, so that 0 can mean "nothing" in a label image. In both, -1 is a region that was matched to nothing.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Ints = NDArray[np.int64]


def renumber(clusters: Ints) -> Ints:
    """(D,) the same partition, numbered from 0 in the order of the first members; negative numbers become -1."""
    values, first, inverse = np.unique(clusters, return_index=True, return_inverse=True)
    first = np.where(values < 0, -1, first)  # the unmatched rank before all clusters, and get -1
    rank = first.argsort(kind="stable").argsort(kind="stable") - int((values < 0).sum())
    return np.maximum(rank, -1)[inverse].astype(np.int64)


def number_instances(clusters: Ints) -> Tensor:
    """(D,) int64 instance ids on the CPU, numbered from 1 in the order of the first members; -1 stays -1."""
    ids = renumber(clusters)
    return torch.from_numpy(np.where(ids < 0, -1, ids + 1))


def drop_singletons(clusters: Ints) -> Ints:
    """(D,) the same clusters (numbers >= 0), with -1 for the only member of its cluster."""
    return np.where(np.bincount(clusters, minlength=1)[clusters] > 1, clusters, -1)


def separate_unmatched(clusters: Ints) -> Ints:
    """(D,) the same numbers, with an unused one of its own for every region that has a negative one."""
    fresh = int(clusters.max(initial=-1)) + 1 + np.arange(len(clusters))
    return np.where(clusters < 0, fresh, clusters)


def members_of(clusters: Ints, num_clusters: int | None = None) -> list[Ints]:
    """The members of clusters 0 .. K - 1 in ascending order; an unused number has none, -1 is left out. Without K, up
    to the largest number."""
    num_clusters = int(clusters.max(initial=-1)) + 1 if num_clusters is None else num_clusters
    order = np.argsort(clusters, kind="stable")
    starts = np.searchsorted(clusters[order], np.arange(num_clusters + 1))
    return [order[start:stop] for start, stop in pairwise(starts)]
