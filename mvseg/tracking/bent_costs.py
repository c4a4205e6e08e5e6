"""Costs of links between two dates that are aligned: `fitted_costs`, once the earlier plant is bent as its pairs say.

A plant leans, and its internodes stretch: each leaf moves as those around it did, and the better these agree, the more
places tell. Both are regressions with a prior worth some pairs, so that only many pairs move the costs much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvseg.tracking.align import Alignment
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import LINKS, fitted_costs
from mvseg.tracking.leaves import DateLeaves, Pair
from mvseg.tracking.numbers import COSTS


def bent_costs(pair: Pair, alignment: Alignment) -> Floats:
    """(N, M) costs of links, below 0 where leaves are likelier one than not."""
    bent, widths = bend(pair, alignment)
    return fitted_costs(replace(pair, first=bent), LINKS, widths)


def bend(pair: Pair, alignment: Alignment) -> tuple[DateLeaves, Floats]:
    """The leaves of the earlier date where the later one should show them, and (N,) factors of the scales of places.

    The shift of a base is linear in its place: a ridge regression over the pairs, `COSTS.prior_pairs` strong, of which
    each leaf is predicted without its own pair. Factors grow with the variance of that prediction, and with the median
    error of all, which weighs against `COSTS.usual` as the pairs do against the prior. Without pairs nothing bends.
    """
    first, prior = pair.first.moved(alignment.pose), COSTS.prior_pairs
    rows, columns = alignment.pairs.T
    if not len(rows):
        return first, np.ones(len(first))
    away = (pair.second.bases[columns] - first.bases[rows]) / pair.scale
    places = np.column_stack([np.ones(len(first)), (first.bases - first.bases[rows].mean(0)) / pair.scale])
    terms = places[rows]
    weights = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / COSTS.usual))
    inverse = np.linalg.inv((terms.T * weights) @ terms + prior * np.eye(4))
    shifts = places @ (inverse @ (terms.T * weights) @ away)
    variances = np.einsum("ni,ij,nj->n", places, inverse, places)
    others = 1 - weights * variances[rows]  # > 0, as the prior counts, too
    errors = (away - shifts[rows]) / others[:, None]
    shifts[rows], variances[rows] = away - errors, variances[rows] / others
    median = float(np.median(np.linalg.norm(errors[:, :2], axis=1))) / COSTS.usual
    spread = (prior + len(rows) * median**2) / (prior + len(rows))
    return first.shifted(shifts * pair.scale), np.sqrt(spread * (1 + variances))
