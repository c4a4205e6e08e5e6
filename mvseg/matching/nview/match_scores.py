"""Stage 5e: how sure a match is: the chance that a region's id is right, from what speaks for it.

A logistic regression, fitted once on simulated development plants (true and degraded masks, 3 to 20 views, 4 to 32
leaves): of the regions scored about 0.8, about 80 % are right there. A region is right when its cluster is the largest
one of its leaf, and its leaf is the most frequent one of its cluster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]

# Intercept, then one for each column of `features`.
COEFFICIENTS = (1.24, 1.20, 2.96, -0.69, 1.26, -0.90, -1.59, -0.95)


@dataclass(frozen=True, eq=False)
class Support:
    """What speaks for the ids of D regions.

    Attributes:
        score: (D,) leave-one-out score in the own cluster.
        margin: (D,) gain of the own cluster less the gain of the best other choice, being alone included.
        landing: (D,) share of the cluster's pixels in other views that expect to be seen on the region.
        weight: (D,) mean epipolar weight to the members in other views.
        num_partners: (D,) int64, members of the cluster in other views; 0 for a region that is alone.
        num_pieces: (D,) int64, members of the cluster in the region's own view, itself included.
        num_views: V.
    """

    score: Floats
    margin: Floats
    landing: Floats
    weight: Floats
    num_partners: Ints
    num_pieces: Ints
    num_views: int


def features(support: Support) -> Floats:
    """(D, 7) what the chance depends on, each limited to a range that the plants fill."""
    others = max(support.num_views - 1, 1)
    return np.stack(
        [
            np.clip(support.score, -0.2, 1),
            np.clip(support.margin, -1, 1.5),
            np.clip(support.landing, 0, 1),
            np.clip(support.weight, 0, 1),
            np.minimum(support.num_partners / others, 1),
            1 / np.maximum(support.num_partners, 1),
            support.num_pieces > 1,
        ],
        1,
    )


def match_scores(support: Support) -> Floats:
    """(D,) in [0, 1]: the chance that each id is right; 0 for regions that are alone."""
    logit = COEFFICIENTS[0] + features(support) @ np.array(COEFFICIENTS[1:])
    return np.where(support.num_partners > 0, 1 / (1 + np.exp(-logit)), 0.0)
