"""Graph clustering by symmetric NMF, and the number of clusters by Eq. 7, as in the paper (Sec. 3.1, 3.4).

The paper does not state the range in which Eq. 7 looks for |k|, and that range decides everything: Eq. 7 is 0 for every
partition into equal parts, so that k = 1, k = |V| and, where all leaves are seen in all views, any merge into equal
groups all tie with the truth. The default range here is [max_v n_v, 2 max_v n_v], n_v the number of masks in view v: an
instance has at most one mask per view, so the lower end holds as long as no mask is split.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.matching.affinity import Affinity
from mvseg.matching.links import Links
from mvseg.matching.partition import number_instances

KS_AT_ONCE = 8
DAMPING = 0.5  # beta of the multiplicative update, as in the paper's SymNMF implementation


@dataclass(frozen=True, eq=False)
class Clustering:
    """Instance ids of the regions.

    Attributes:
        instance_ids: (D,) int64 in [1, K], or -1 for a region without an edge. Instances are numbered in the order of
            their first region; none is empty.
        num_clusters: the |k| of the factorisation; K is smaller where SymNMF left a cluster empty.
        criterion: {k: value of Eq. 7} for each k that was tried.
    """

    instance_ids: Tensor
    num_clusters: int
    criterion: dict[int, float]


def cluster_affinity(
    affinity: Affinity,
    num_per_view: Tensor,
    *,
    num_instances: int | None = None,
    search_range: tuple[int, int] | None = None,
    num_restarts: int = 2,
    seed: int = 0,
    links: Links | None = None,
    progress: bool = False,
) -> Clustering:
    """Cluster the graph with SymNMF; without `num_instances`, |k| is the one with the least Eq. 7 in a range.

    Args:
        affinity: the graph of D regions.
        num_per_view: (V,) int64, regions in each view; sets the default range.
        num_instances: k, if known (>= 1).
        search_range: smallest and largest k to try, both included; None for [max_v n_v, 2 max_v n_v]. The smallest k
            wins a tie.
        num_restarts: random starts per factorisation; the best objective wins.
        seed: for the starts.
        links: of the regions. Those that must be together are one node of the graph, see `contract`. Those that cannot
            have weight 0, and where they get one cluster all the same, see `choose_apart`.
        progress: show a progress bar over k.

    Returns:
        The clustering. Regions without an edge are -1 (the paper does not say; an arg max over a row of zeros would put
        them all into cluster 0). Without regions or edges there are no clusters.

    Raises:
        InputError: a k or a range that is not positive and ordered.
    """
    largest_view = int(num_per_view.max()) if len(num_per_view) else 0
    low, high = search_range or (max(1, largest_view), max(1, 2 * largest_view))
    if num_instances is not None:
        low = high = num_instances
    if not 1 <= low <= high:
        raise InputError(f"the number of instances is searched in [{low}, {high}], expected 1 <= low <= high")
    W, links = affinity.to_dense(), Links.of() if links is None else links
    node = torch.from_numpy(links.components(len(W))).to(W.device)
    apart = torch.zeros((int(node.max()) + 1 if len(node) else 0,) * 2, dtype=torch.bool, device=W.device)
    ends = node[links.cannot.to(W.device)]
    apart[ends[:, 0], ends[:, 1]] = apart[ends[:, 1], ends[:, 0]] = True
    W = contract(W, node).masked_fill(apart, 0) if len(links) else W
    is_linked = W.sum(1) > 0
    labels = torch.full((len(W),), -1, dtype=torch.int64, device=W.device)
    is_alone = ~is_linked & (node.bincount(minlength=len(W)) > 1)  # fits nothing, but must be together
    labels[is_alone] = torch.arange(int(is_alone.sum()), device=W.device)
    if not is_linked.any():
        return Clustering(number_instances(labels[node].cpu().numpy()).to(W.device), 0, {})
    place = (is_linked.cumsum(0) - 1)[node[is_linked[node]]]  # of each region that has an edge
    linked_W = W[is_linked][:, is_linked]
    candidates: dict[int, Tensor] = {}
    criterion: dict[int, float] = {}
    with tqdm(total=high - low + 1, desc="number of instances", unit="k", disable=not progress or low == high) as bar:
        for ks in torch.arange(low, high + 1).split(KS_AT_ONCE):
            factors = factorise(linked_W, ks.tolist(), num_restarts=num_restarts, seed=seed)
            for k, H in zip(ks.tolist(), factors, strict=True):
                candidates[k] = choose_apart(H, apart[is_linked][:, is_linked])
                criterion[k] = size_spread(candidates[k][place], k)
            bar.update(len(ks))
    best = min(criterion, key=lambda k: (criterion[k], k))
    labels[is_linked] = candidates[best]
    labels[is_alone] += int(candidates[best].max()) + 1
    ids = number_instances(labels[node].cpu().numpy()).to(labels.device)
    return Clustering(instance_ids=ids, num_clusters=best, criterion=criterion)


def contract(W: Tensor, node: Tensor) -> Tensor:
    """The graph whose nodes are regions that must be together, so that SymNMF of it is that of W under this condition.

    With equal rows of H for the regions of one node, H = Q G. Q, 1 / sqrt(size) where a region is in a node, is
    orthonormal, so |W - H H^T|^2 is |Q^T W Q - G G^T|^2 and a constant.

    Args:
        W: (D, D) symmetric, >= 0.
        node: (D,) int64 in [0, N), none of them empty.

    Returns:
        (N, N) symmetric, >= 0: Q^T W Q.
    """
    Q = torch.nn.functional.one_hot(node).to(W)
    Q = Q / Q.sum(0).sqrt()
    return Q.T @ W @ Q


def choose_apart(H: Tensor, apart: Tensor) -> Tensor:
    """(D,) int64, the cluster of each node: the arg max of its row of H (D, k).

    Where nodes that are `apart` (D, D) bool choose the same, those with the larger share of their row in it choose
    first, and the others take the next best that is left, or a cluster of their own, from k on.
    """
    labels = H.argmax(1)
    share = H.max(1).values / H.sum(1).clamp(min=torch.finfo(H.dtype).tiny)
    some = apart.any(1).nonzero()[:, 0]
    fresh = H.shape[1]
    labels[some] = -1
    for row in some[share[some].argsort(descending=True, stable=True)].tolist():
        taken = labels[apart[row]]
        free = H[row].clone()
        free[taken[(taken >= 0) & (taken < H.shape[1])]] = -1
        labels[row] = free.argmax() if free.max() > 0 else fresh
        fresh += int(labels[row] == fresh)
    return labels


def factorise(
    W: Tensor, ks: Sequence[int], *, num_restarts: int = 2, num_iterations: int = 200, seed: int = 0
) -> list[Tensor]:
    """Symmetric non-negative matrix factorisation W ~ H H^T (Kuang et al. 2012), by multiplicative updates.

    All k are factorised together, padded to the widest: the surplus columns of a smaller k start at 0, and a
    multiplicative update keeps them there.

    Args:
        W: (D, D) symmetric, >= 0.
        ks: numbers of columns of H; the result for one k does not depend on the others.
        num_restarts: random starts for each k; the H of the smallest |W - H H^T| is returned.
        num_iterations: updates of each start.
        seed: for the starts, which are drawn on the CPU so that they are the same on every device.

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
        H = H * (1 - DAMPING + DAMPING * (H @ W) / denominator.clamp(min=1e-12))
    # |W - H^T H|^2 without its constant |W|^2
    loss = (H @ H.mT).square().sum((1, 2)) - 2 * ((H @ W) * H).sum((1, 2))
    best = loss.reshape(len(ks), num_restarts).argmin(1)
    return [H[row * num_restarts + int(best[row]), :k].T for row, k in enumerate(ks)]


def size_spread(labels: Tensor, k: int) -> float:
    """Eq. 7: root of the sum (as printed, no mean) of squared deviations of the k cluster sizes from their mean."""
    sizes = torch.bincount(labels, minlength=k).double()
    return float((sizes - sizes.mean()).square().sum().sqrt())
