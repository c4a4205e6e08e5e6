from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics


def test_eq_8_by_hand() -> None:
    estimated = torch.tensor([0, 0, 0, 1, 1, 2])
    true = torch.tensor([5, 5, 7, 7, 7, 5])
    metrics = matching_metrics(estimated, true)
    assert metrics.s_match == pytest.approx((2 + 2 + 1) / 6)
    assert (metrics.num_estimated, metrics.num_true, metrics.e_k) == (3, 2, 1)


def test_pairs_agree_with_a_loop() -> None:
    generator = np.random.default_rng(0)
    estimated, true = generator.integers(0, 5, 40), generator.integers(0, 4, 40)
    together = tied = both = 0
    for a in range(40):
        for b in range(a):
            together += estimated[a] == estimated[b]
            tied += true[a] == true[b]
            both += estimated[a] == estimated[b] and true[a] == true[b]
    metrics = matching_metrics(torch.from_numpy(estimated), torch.from_numpy(true))
    assert metrics.pair_precision == pytest.approx(both / together)
    assert metrics.pair_recall == pytest.approx(both / tied)
    assert metrics.pair_f1 == pytest.approx(2 * both / (together + tied))


@pytest.mark.parametrize("seed", range(5))
def test_ari_is_scikit_learns(seed: int) -> None:
    from sklearn.metrics import adjusted_rand_score  # here, as it takes a second to load

    generator = np.random.default_rng(seed)
    estimated, true = generator.integers(0, 1 + seed, 30), generator.integers(3, 7, 30)
    metrics = matching_metrics(torch.from_numpy(estimated), torch.from_numpy(true))
    assert metrics.ari == pytest.approx(adjusted_rand_score(true, estimated), abs=1e-12)


def test_unmatched_regions_and_degenerate_cases() -> None:
    true = torch.tensor([1, 1, 2, 2])
    unmatched = matching_metrics(torch.tensor([-1, -1, 0, 0]), true)
    single = matching_metrics(torch.tensor([1, 2, 0, 0]), true)
    assert unmatched == single
    assert unmatched.num_estimated == 3
    assert matching_metrics(torch.full((4,), -1), true).s_match == 1  # why s_match is never read alone
    nothing = torch.zeros(0, dtype=torch.int64)
    assert matching_metrics(nothing, nothing).ari == 1
    alone = matching_metrics(torch.tensor([0, 1]), torch.tensor([3, 4]))
    assert (alone.pair_precision, alone.pair_recall, alone.pair_f1) == (1, 1, 1)
    with pytest.raises(InputError, match="estimated ids"):
        matching_metrics(torch.tensor([0]), torch.tensor([0, 1]))
