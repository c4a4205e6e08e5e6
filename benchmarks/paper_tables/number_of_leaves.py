"""The question of |k|: SymNMF with the number of leaves given, and found by Eq. 7 in one range or another."""

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

# name -> smallest and largest k as multiples of m, the largest number of masks in a view; below 2 stands for 2
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
    """{rule: measures} of the paper's clustering, for all `RULES`; all of them choose among the same partitions.

    The last rule is Eq. 7 as a standard deviation: with the mean over the clusters where the paper prints the sum.
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
        found = matching_metrics(partitions[k][judged], masks.true_ids[judged])
        record[name] = {"s_match": found.s_match, "e_k": found.e_k, "ari": found.ari, "f1": found.pair_f1, "k": k}
    return record


def partition_all(cell: Cell, masks: Masks, ks: list[int]) -> dict[int, Tensor]:
    """{k: (D,) labels, -1 for masks that are tied to no other}: what `cluster_affinity` does for each k."""
    affinity = region_affinity(masks.regions, cell.scene.cameras)
    W = affinity.to_dense()
    tied = W.sum(1) > 0
    partitions = {}
    for start in range(0, len(ks), KS_AT_ONCE):
        some = ks[start : start + KS_AT_ONCE]
        for k, H in zip(some, factorise(W[tied][:, tied], some), strict=True):
            labels = torch.full((len(W),), -1, dtype=torch.int64)
            labels[tied] = H.argmax(1)
            partitions[k] = labels
    return partitions
