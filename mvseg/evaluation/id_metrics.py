"""How good are the ids: s_match (Eq. 8), e_k, ARI, pairs.

Ids are compared as partitions: their numbers mean nothing. A region that is matched to nothing (-1) counts as a cluster
of its own. Always read s_match together with the others: all regions on their own score s_match = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sklearn.metrics import adjusted_rand_score
from sklearn.metrics.cluster import contingency_matrix, pair_confusion_matrix
from torch import Tensor

from mvseg.errors import InputError


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
        num_regions: D.
        num_estimated: clusters found, single regions included.
        num_true: true instances.
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


def matching_metrics(instance_ids: Tensor, true_ids: Tensor) -> MatchingMetrics:
    """Compare two int64 (D,) id vectors; -1 in the estimate is a cluster of its own.

    Without regions: s_match, ari and the pair scores are 1 and the rest 0.

    Raises:
        InputError: the vectors differ in length.
    """
    if instance_ids.shape != true_ids.shape or instance_ids.ndim != 1:
        raise InputError(f"{tuple(instance_ids.shape)} estimated ids with {tuple(true_ids.shape)} true ones")
    estimated, true = _split_unmatched(instance_ids), true_ids.cpu().numpy()
    if not len(true):
        return MatchingMetrics(1.0, 0, 1.0, 1.0, 1.0, 1.0, 0, 0, 0)
    table = contingency_matrix(true, estimated)
    (_, false_pairs), (missed_pairs, true_pairs) = pair_confusion_matrix(true, estimated).tolist()
    precision = true_pairs / (true_pairs + false_pairs) if true_pairs + false_pairs else 1.0
    recall = true_pairs / (true_pairs + missed_pairs) if true_pairs + missed_pairs else 1.0
    num_true, num_estimated = table.shape
    return MatchingMetrics(
        s_match=float(table.max(0).sum() / len(true)),
        e_k=abs(num_estimated - num_true),
        ari=float(adjusted_rand_score(true, estimated)),
        pair_precision=precision,
        pair_recall=recall,
        pair_f1=2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        num_regions=len(true),
        num_estimated=num_estimated,
        num_true=num_true,
    )


def _split_unmatched(instance_ids: Tensor) -> np.ndarray:
    ids = instance_ids.cpu().numpy().copy()
    alone = ids < 0
    ids[alone] = max(int(ids.max(initial=-1)), -1) + 1 + np.arange(alone.sum())
    return ids
