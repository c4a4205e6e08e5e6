"""How good the ids are: s_match (Eq. 8), e_k, ARI, pairs.

Ids are compared as partitions: their numbers mean nothing. A region that is matched to nothing (-1) counts as a cluster
of its own. Always read s_match together with the others: if every region is its own cluster, s_match is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats.contingency import crosstab
from torch import Tensor

from mvseg.errors import InputError, check_arguments
from mvseg.matching.partition import separate_unmatched


@dataclass(frozen=True)
class MatchingMetrics:
    """Agreement of estimated with true instance ids over D regions.

    Attributes:
        s_match: Eq. 8, purity: share of regions whose true id is the most frequent one of their cluster.
        e_k: absolute error of the number of instances.
        ari: adjusted Rand index, 1 for equal partitions, about 0 for random ones.
        pair_precision: of the pairs put together, the share that belongs together (1 when no pair is put together).
        pair_recall: of the pairs that belong together, the share put together (1 when there is none).
        pair_f1: their harmonic mean.
        num_estimated: estimated clusters, single regions included.
    """

    s_match: float
    e_k: int
    ari: float
    pair_precision: float
    pair_recall: float
    pair_f1: float
    num_regions: int
    num_estimated: int
    num_true: int


@check_arguments
def matching_metrics(instance_ids: Tensor, true_ids: Tensor) -> MatchingMetrics:
    """Compare two int64 (D,) id vectors of any device; -1 in the estimate is a cluster of its own.

    Without regions: s_match, ari and the pair scores are 1 and the rest 0.

    Raises:
        InputError: the vectors differ in length.
    """
    if instance_ids.shape != true_ids.shape or instance_ids.ndim != 1:
        shapes = f"{tuple(instance_ids.shape)} estimated ids with {tuple(true_ids.shape)} true ones"
        raise InputError(f"{shapes}, expected two vectors of equal length")
    table = crosstab(true_ids.cpu().numpy(), separate_unmatched(instance_ids.cpu().numpy())).count
    both, true_pairs, estimated_pairs = (count_pairs(sizes) for sizes in (table, table.sum(1), table.sum(0)))
    count = len(true_ids)
    # Hubert and Arabie (1985): pairs in both, less those expected by chance, over the largest possible difference
    by_chance = true_pairs * estimated_pairs / max(count_pairs(np.array([count])), 1)
    largest = (true_pairs + estimated_pairs) / 2
    return MatchingMetrics(
        s_match=share(int(table.max(0, initial=0).sum()), count),
        e_k=abs(table.shape[1] - table.shape[0]),
        ari=1.0 if largest == by_chance else (both - by_chance) / (largest - by_chance),
        pair_precision=share(both, estimated_pairs),
        pair_recall=share(both, true_pairs),
        pair_f1=share(2 * both, estimated_pairs + true_pairs),
        num_regions=count,
        num_estimated=table.shape[1],
        num_true=table.shape[0],
    )


def share(part: float, whole: float) -> float:
    """`part` / `whole`; 1 where there is nothing to count."""
    return part / whole if whole else 1.0


def count_pairs(sizes: np.ndarray) -> int:
    """How many pairs of elements share a group, from the group sizes."""
    return int((sizes * (sizes - 1) // 2).sum())
