"""The question of |k|: SymNMF with the number of leaves given, or found by Eq. 7 in different ranges."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.paper_tables.cells import Cell, Record
from benchmarks.paper_tables.masks import Masks
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.symnmf import factorise, size_spread

KS_AT_ONCE = 8
DEFAULT = "[m, 2 m]"

# name -> smallest and largest k as multiples of m, the largest number of masks in a view; at least 2
RANGES = {
    "m": (1.0, 1.0),
    "[m, 1.5 m]": (1.0, 1.5),
    DEFAULT: (1.0, 2.0),
    "[m, 3 m]": (1.0, 3.0),
    "[m / 2, 2 m]": (0.5, 2.0),
    "[2, 2 m]": (0.0, 2.0),
}
RULES = ("k given", *RANGES, f"{DEFAULT}, mean for the sum")


def score_numbers(cell: Cell, masks: Masks) -> Record:
    """{rule: measures} of the paper's clustering for all `RULES`, which choose among the same partitions.

    The last rule is Eq. 7 as a standard deviation: with a mean over the clusters in place of the paper's sum.
    """
    judged = masks.true_ids > 0
    most = int(masks.regions.num_per_view.max())
    given = len(masks.true_ids[judged].unique())
    partitions = partition_all(cell, masks, sorted({given, *range(2, max(2, 3 * most) + 1)}))
    spread = {k: size_spread(labels[labels >= 0], k) for k, labels in partitions.items()}
    chosen = {"k given": given}
    for name, (low, high) in RANGES.items():
        ks = range(max(2, math.ceil(low * most)), max(2, math.floor(high * most)) + 1)
        chosen[name] = min(ks, key=lambda k: (spread[k], k))
    ks = range(max(2, most), max(2, 2 * most) + 1)
    chosen[RULES[-1]] = min(ks, key=lambda k: (spread[k] / k**0.5, k))
    record: Record = {}
    for name, k in chosen.items():
        metrics = matching_metrics(partitions[k][judged], masks.true_ids[judged])
        record[name] = {"s_match": metrics.s_match, "e_k": metrics.e_k, "ari": metrics.ari}
    return record


def partition_all(cell: Cell, masks: Masks, ks: list[int]) -> dict[int, Tensor]:
    """{k: (D,) labels, -1 for masks without an edge}: what `cluster_affinity` does for each k."""
    affinity = region_affinity(masks.regions, cell.scene.cameras)
    W = affinity.to_dense()
    has_edge = W.sum(1) > 0
    partitions = {}
    for start in range(0, len(ks), KS_AT_ONCE):
        some = ks[start : start + KS_AT_ONCE]
        for k, H in zip(some, factorise(W[has_edge][:, has_edge], some), strict=True):
            labels = torch.full((len(W),), -1, dtype=torch.int64)
            labels[has_edge] = H.argmax(1)
            partitions[k] = labels
    return partitions
