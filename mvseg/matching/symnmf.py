"""Graph clustering by symmetric NMF, and the number of clusters by Eq. 7, as in the paper (Sec. 3.1, 3.4).

The paper does not state the range in which Eq. 7 looks for |k|, and that range decides everything: Eq. 7 is 0 for every
partition into equal parts, so k = 1, k = |V| and, where all leaves are seen in all views, any merge into equal groups
all tie with the truth. The default range here is [max_v n_v, 2 max_v n_v], n_v the number of masks in view v: an
instance has at most one mask per view, so the lower end holds as long as no mask is split.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mvseg.errors import check_arguments
from mvseg.matching.affinity import Affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.numbers import SYMNMF
from mvseg.matching.partition import Clusters
from mvseg.system.running import progress_bar


@dataclass(frozen=True, eq=False)
class Clustering:
    """Instance ids of the regions.

    Attributes:
        instance_ids: (D,) int64 in [1, K], in the order of their first region, none empty; -1 for a region without an
            edge.
        num_clusters: the |k| of the factorisation; K is smaller where SymNMF left a cluster empty.
        criterion: {k: value of Eq. 7} for each k that was tried.
    """

    instance_ids: Tensor
    num_clusters: int
    criterion: dict[int, float]


@check_arguments
def cluster_affinity(
    affinity: Affinity,
    num_per_view: Tensor,
    *,
    num_instances: int | None = None,
    search_range: tuple[int, int] | None = None,
    num_restarts: int = 2,
    seed: int = 0,
) -> Clustering:
    """Cluster the graph with SymNMF; without `num_instances`, |k| is the one with the least Eq. 7 in a range.

    Args:
        num_per_view: (V,) int64, regions in each view; sets the default range.
        num_instances: k, if known (>= 1).
        search_range: smallest and largest k to try, both included; None for [max_v n_v, 2 max_v n_v]. The smallest k
            wins a tie.
        num_restarts: random starts per factorisation; the best objective wins.

    Returns:
        The clustering. Regions without an edge are -1 (the paper does not say; an arg max over a row of zeros would put
        them all into cluster 0). Without regions or edges there are no clusters.

    Raises:
        InputError: a k or a range that is not positive and ordered.
    """
    config = MatchConfig(
        method="symnmf", num_instances=num_instances, search_range=search_range, num_restarts=num_restarts, seed=seed
    )
    return cluster_weights(affinity.to_dense(), num_per_view, config)


def cluster_weights(W: Tensor, num_per_view: Tensor, config: MatchConfig) -> Clustering:
    """`cluster_affinity` of the weights W (D, D), symmetric, >= 0."""
    largest_view = int(num_per_view.max()) if len(num_per_view) else 0
    low, high = config.search_range or (max(1, largest_view), max(1, 2 * largest_view))
    if config.num_instances is not None:
        low = high = config.num_instances
    is_linked = W.sum(1) > 0
    labels = torch.full((len(W),), -1, dtype=torch.int64, device=W.device)
    if not is_linked.any():
        return Clustering(labels, 0, {})
    candidates: dict[int, Tensor] = {}
    criterion: dict[int, float] = {}
    with progress_bar(total=high - low + 1, name="number of instances", unit="number") as bar:
        for ks in torch.arange(low, high + 1).split(SYMNMF.ks_at_once):
            linked_W = W[is_linked][:, is_linked]
            factors = factorise(linked_W, ks.tolist(), num_restarts=config.num_restarts, seed=config.seed)
            for k, H in zip(ks.tolist(), factors, strict=True):
                candidates[k] = H.argmax(1)
                criterion[k] = size_spread(candidates[k], k)
            bar.update(len(ks))
    best = min(criterion, key=lambda k: (criterion[k], k))
    labels[is_linked] = candidates[best]
    ids = Clusters.of(labels.cpu().numpy()).instance_ids().to(W.device)
    return Clustering(instance_ids=ids, num_clusters=best, criterion=criterion)


def factorise(
    W: Tensor, ks: Sequence[int], *, num_restarts: int = 2, num_iterations: int = 200, seed: int = 0
) -> list[Tensor]:
    """Symmetric non-negative matrix factorisation W ~ H H^T (Kuang et al. 2012), by multiplicative updates.

    All k are factorised together, padded to the widest: the surplus columns of a smaller k start at 0, and a
    multiplicative update keeps them there. The result for one k does not depend on the others.

    Args:
        W: (D, D) symmetric, >= 0.
        ks: numbers of columns of H.
        num_restarts: random starts for each k, drawn on the CPU so that they are the same on every device; the H of the
            smallest |W - H H^T| is returned.

    Returns:
        For each k an H, (D, k) float32 >= 0; the arg max of a row is the cluster of that node.
    """
    widest = max(ks)
    scale = 2 * W.mean().clamp(min=torch.finfo(W.dtype).tiny).sqrt()
    starts = torch.zeros(len(ks), num_restarts, widest, len(W))
    for row, k in enumerate(ks):
        generator = torch.Generator().manual_seed(seed + 1_000_003 * k)
        starts[row, :, :k] = torch.rand(num_restarts, k, len(W), generator=generator) / k**0.5
    H = starts.flatten(0, 1).to(W) * scale  # transposed, (B, k, D), so that H W is one matrix product
    for _ in range(num_iterations):
        denominator = (H @ H.mT) @ H
        H = H * (1 - SYMNMF.damping + SYMNMF.damping * (H @ W) / denominator.clamp(min=1e-12))
    # |W - H^T H|^2 without its constant |W|^2
    loss = (H @ H.mT).square().sum((1, 2)) - 2 * ((H @ W) * H).sum((1, 2))
    best = loss.reshape(len(ks), num_restarts).argmin(1)
    return [H[row * num_restarts + int(best[row]), :k].T for row, k in enumerate(ks)]


def size_spread(labels: Tensor, k: int) -> float:
    """Eq. 7: root of the sum (as printed, no mean) of squared deviations of the k cluster sizes from their mean."""
    sizes = torch.bincount(labels, minlength=k).double()
    return float((sizes - sizes.mean()).square().sum().sqrt())
