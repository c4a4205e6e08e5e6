"""Which rows name which regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RowsOfRegions:
    """For each of D regions, which of R rows name it: rows are found without looking at those that do not.

    Attributes:
        rows: int32, the rows of region 0, then those of region 1, ...
        offsets: (D + 1,) int64: region d is named by `rows[offsets[d]:offsets[d + 1]]`.
        num_rows: R.
    """

    rows: NDArray[np.int32]
    offsets: Ints
    num_rows: int

    def count(self, clusters: list[Ints]) -> Floats:
        """(C, R) float32: how many views show a member of each of C clusters in each row."""
        counts = np.zeros((len(clusters), self.num_rows), np.float32)
        for number, members in enumerate(clusters):
            parts = [self.rows[self.offsets[region] : self.offsets[region + 1]] for region in members.tolist()]
            if parts:
                counts[number] = np.bincount(np.concatenate(parts), minlength=self.num_rows)
        return counts


def index_rows(labels: NDArray[np.integer], num_regions: int) -> RowsOfRegions:
    """The index of R rows (R, V) by the regions that they name."""
    flat = labels.ravel()
    order = np.argsort(flat, kind="stable")  # of int16, a radix sort
    offsets = np.searchsorted(flat[order], np.arange(num_regions + 1))
    rows = (order // max(labels.shape[1], 1)).astype(np.int32)
    return RowsOfRegions(rows=rows, offsets=offsets, num_rows=len(labels))
