"""Index of hypotheses by the regions that they name, and sets of views as bits."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Ints


@dataclass(frozen=True, eq=False)
class HypothesesOfRegions:
    """Index of R hypotheses by the D regions that they name.

    Attributes:
        hypotheses: int32, the hypotheses of region 0, then those of region 1, ...
        offsets: D + 1 numbers: region d is named by `hypotheses[offsets[d]:offsets[d + 1]]`.
    """

    hypotheses: NDArray[np.int32]
    offsets: list[int]
    num_hypotheses: int

    def count(self, clusters: list[Ints]) -> tuple[Ints, Ints, Ints]:
        """Count the views that show a member of each of C clusters. Returns three int64 arrays with an entry per
        cluster and hypothesis in which any view does, in this order: cluster, hypothesis, views."""
        parts = [
            [self.hypotheses[self.offsets[region] : self.offsets[region + 1]] for region in members.tolist()]
            for members in clusters
        ]
        lengths = [sum(map(len, of_cluster)) for of_cluster in parts]
        kind: type[np.int32 | np.int64] = np.int32 if len(clusters) * self.num_hypotheses < 2**31 else np.int64
        first = np.arange(len(clusters)).astype(kind) * self.num_hypotheses  # of each cluster
        cell = np.repeat(first, lengths)
        if len(cell):
            cell += np.concatenate(list(chain.from_iterable(parts)))
        cell.sort()
        start = np.flatnonzero(np.append(True, cell[1:] != cell[:-1])) if len(cell) else np.zeros(0, np.int64)
        cell, views = cell[start], np.diff(start, append=len(cell))
        cluster = np.repeat(np.arange(len(clusters)), np.diff(np.searchsorted(cell, first), append=len(cell)))
        return cluster, cell - first[cluster], views


def index_hypotheses(labels: NDArray[np.integer], num_regions: int) -> HypothesesOfRegions:
    """The index of R hypotheses (R, V) by the regions that they name."""
    flat = labels.ravel()
    order = np.argsort(flat, kind="stable")  # of int16, a radix sort
    offsets = np.searchsorted(flat[order], np.arange(num_regions + 1)).tolist()
    hypotheses = (order // max(labels.shape[1], 1)).astype(np.int32)
    return HypothesesOfRegions(hypotheses=hypotheses, offsets=offsets, num_hypotheses=len(labels))


def pack_views(is_view: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """(W, N): sets of views (N, V) as bits, 64 of them in a word."""
    packed = np.packbits(is_view, axis=1)
    return np.pad(packed, ((0, 0), (0, -packed.shape[1] % 8))).view(np.uint64).T.copy()
