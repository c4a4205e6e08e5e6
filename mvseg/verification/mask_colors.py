"""Colours of candidates, against those of the clear leaves of the same plant.

A board beside the plant has colours that none of its leaves has. A red leaf has those of the other leaves of a red
plant. How light a pixel is does not count: leaves shade each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array, vstack

from mvseg.arrays import Bools, Floats
from mvseg.verification.evidence import Drawn
from mvseg.verification.numbers import COLORS


@dataclass(frozen=True, eq=False)
class MaskColors:
    """`counts` (D, B): pixels of each of B colours in each mask, see `Drawn`."""

    counts: csr_array

    @staticmethod
    def of(drawn: Sequence[Drawn]) -> MaskColors | None:
        """Count the colours of V views that were drawn with their photos; None without these."""
        rows, counts = [], []
        for each in drawn:
            if each.colors is None:
                return None
            pixels = np.arange(len(each.colors))
            is_color = csr_array((np.ones(len(pixels)), (pixels, each.colors)), shape=(len(pixels), COLORS.hues**2))
            counts.append(each.masks.T @ is_color)
            rows.append(each.rows)
        return MaskColors(csr_array(vstack(counts, format="csr"))[np.argsort(np.concatenate(rows))]) if counts else None

    def likeness(self, weights: Floats, is_clear: Bools) -> Floats:
        """(K,) how alike the colours of each candidate and of the median clear leaf are: natural logarithm of
        Bhattacharyya's coefficient, less the median of the clear leaves (`is_clear`). 0 where there are fewer than two
        of these. `weights` (D, K): how much each mask counts for each candidate."""
        shape = -1, COLORS.hues, COLORS.hues
        shares = gaussian_filter((self.counts.T @ weights).T.reshape(shape), (0, COLORS.blur, COLORS.blur))
        shares = np.sqrt(shares.reshape(len(is_clear), -1))
        shares /= np.maximum(np.linalg.norm(shares, axis=1, keepdims=True), 1e-12)
        clear = np.flatnonzero(is_clear)
        if len(clear) < 2:
            return np.zeros(len(is_clear))
        alike = np.where(clear == np.arange(len(is_clear))[:, None], np.nan, shares @ shares[clear].T)
        logs = np.log(np.maximum(np.nanmedian(alike, axis=1), COLORS.least_alike))
        return np.asarray(logs - np.median(logs[clear]), np.float64)
