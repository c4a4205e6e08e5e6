"""Which hypotheses name which regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class HypothesesOfRegions:
    """For each of D regions, which of R hypotheses name it: hypotheses are found without looking at those that do not.

    Attributes:
        hypotheses: int32, the hypotheses of region 0, then those of region 1, ...
        offsets: (D + 1,) int64: region d is named by `hypotheses[offsets[d]:offsets[d + 1]]`.
        num_hypotheses: R.
    """

    hypotheses: NDArray[np.int32]
    offsets: Ints
    num_hypotheses: int

    def count(self, clusters: list[Ints]) -> Floats:
        """(C, R) float32: how many views show a member of each of C clusters in each hypothesis."""
        counts = np.zeros((len(clusters), self.num_hypotheses), np.float32)
        for number, members in enumerate(clusters):
            parts = [self.hypotheses[self.offsets[region] : self.offsets[region + 1]] for region in members.tolist()]
            if parts:
                counts[number] = np.bincount(np.concatenate(parts), minlength=self.num_hypotheses)
        return counts


def index_hypotheses(labels: NDArray[np.integer], num_regions: int) -> HypothesesOfRegions:
    """The index of R hypotheses (R, V) by the regions that they name."""
    flat = labels.ravel()
    order = np.argsort(flat, kind="stable")  # of int16, a radix sort
    offsets = np.searchsorted(flat[order], np.arange(num_regions + 1))
    hypotheses = (order // max(labels.shape[1], 1)).astype(np.int32)
    return HypothesesOfRegions(hypotheses=hypotheses, offsets=offsets, num_hypotheses=len(labels))
