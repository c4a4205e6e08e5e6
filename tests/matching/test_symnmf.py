from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import Affinity
from mvseg.matching.symnmf import cluster_affinity, factorise, size_spread
from reference import factorise_reference


def block_graph(sizes: list[int], noise: float = 0.15, seed: int = 0) -> tuple[Affinity, torch.Tensor]:
    """Clusters of the given sizes: weights near 1 inside, below `noise` between."""
    generator = torch.Generator().manual_seed(seed)
    truth = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    edges = torch.combinations(torch.arange(len(truth)))
    inside = truth[edges[:, 0]] == truth[edges[:, 1]]
    draw = torch.rand(len(edges), generator=generator)
    return Affinity(edges, torch.where(inside, 0.8 + 0.2 * draw, noise * draw + 1e-6), len(truth)), truth


def test_finds_the_blocks_and_their_number() -> None:
    affinity, truth = block_graph([5, 5, 5, 5, 5, 5])
    clustering = cluster_affinity(affinity, torch.tensor([6, 6, 6, 6, 6]))
    assert clustering.num_clusters == 6
    assert matching_metrics(clustering.instance_ids, truth).ari == 1
    assert sorted(clustering.criterion) == [6, 7, 8, 9, 10, 11, 12]
    assert clustering.criterion[6] == 0


def test_given_k_and_given_range_decide() -> None:
    affinity, truth = block_graph([4, 4, 4])
    given = cluster_affinity(affinity, torch.tensor([9]), num_instances=3)
    assert list(given.criterion) == [3]
    assert matching_metrics(given.instance_ids, truth).ari == 1
    ranged = cluster_affinity(affinity, torch.tensor([9]), search_range=(2, 4))
    assert sorted(ranged.criterion) == [2, 3, 4]
    assert ranged.num_clusters == 3
    # Eq. 7 is 0 for k = 1 as for the true k: a range that starts at 1 finds one instance.
    affinity, _ = block_graph([4, 4, 4])
    assert cluster_affinity(affinity, torch.tensor([3]), search_range=(1, 6)).num_clusters == 1


def test_regions_without_an_edge_are_unmatched() -> None:
    affinity, truth = block_graph([4, 4])
    wider = Affinity(affinity.edges, affinity.weights, len(truth) + 2)
    clustering = cluster_affinity(wider, torch.tensor([4, 4]), num_instances=2)
    assert clustering.instance_ids[-2:].tolist() == [-1, -1]
    assert matching_metrics(clustering.instance_ids[:-2], truth).ari == 1
    none = Affinity(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0), 3)
    clustering = cluster_affinity(none, torch.tensor([2, 1]))
    assert clustering.instance_ids.tolist() == [-1, -1, -1]
    assert clustering.num_clusters == 0


@pytest.mark.parametrize("search_range", [(0, 3), (4, 3)])
def test_impossible_range_is_refused(search_range: tuple[int, int]) -> None:
    affinity, _ = block_graph([2, 2])
    with pytest.raises(InputError, match="expected 1 <= smallest <= largest"):
        cluster_affinity(affinity, torch.tensor([2]), search_range=search_range)


def test_factorise_agrees_with_the_element_wise_update() -> None:
    W = block_graph([3, 4, 3], noise=0.4)[0].to_dense()
    k, seed = 3, 5
    scale = 2 * W.mean().sqrt()
    start = torch.rand(1, k, len(W), generator=torch.Generator().manual_seed(seed + 1_000_003 * k))[0] / k**0.5 * scale
    expected = factorise_reference(W.numpy().astype(np.float64), start.T.numpy().astype(np.float64), 30)
    (H,) = factorise(W, [k], num_restarts=1, num_iterations=30, seed=seed)
    np.testing.assert_allclose(H.numpy(), expected, rtol=2e-3, atol=1e-5)
    W = block_graph([3, 4, 3, 5], noise=0.4)[0].to_dense()
    together = factorise(W, [2, 4, 7], seed=1)
    for k, H in zip([2, 4, 7], together, strict=True):
        assert H.shape == (len(W), k)
        torch.testing.assert_close(factorise(W, [k], seed=1)[0], H, rtol=1e-3, atol=1e-4)


def test_eq_7_by_hand() -> None:
    assert size_spread(torch.tensor([0, 0, 1, 1]), 2) == 0
    assert size_spread(torch.tensor([0, 0, 0, 1]), 2) == pytest.approx(2**0.5)  # sizes 3, 1 about 2
    assert size_spread(torch.tensor([0, 0, 0]), 3) == pytest.approx(6**0.5)  # sizes 3, 0, 0 about 1
