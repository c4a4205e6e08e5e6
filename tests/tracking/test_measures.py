"""The measures of `benchmarks/tracking.py` against TrackEval, and against all ways to name tracks."""

from __future__ import annotations

from itertools import permutations, zip_longest

import numpy as np
import pytest

from benchmarks.tracking import Labels, measure


def draw_labels(seed: int) -> tuple[Labels, Labels]:
    """Four leaves on five dates, some missed, and tracks of them that are wrong now and then."""
    rng = np.random.default_rng(seed)
    truth = [rng.permutation(np.arange(1, 5))[: rng.integers(2, 5)].tolist() for _ in range(5)]
    found = [rng.permutation(date).tolist() if rng.random() < 0.4 else list(date) for date in truth]
    return truth, found


def best_idf1(truth: Labels, found: Labels) -> float:
    """IDF1 of the best of all ways to give tracks to leaves."""
    pairs = [pair for date in zip(truth, found, strict=True) for pair in zip(*date, strict=True)]
    leaves, tracks = (sorted(set(side)) for side in zip(*pairs, strict=True))
    if len(leaves) > len(tracks):
        pairs, leaves, tracks = [(b, a) for a, b in pairs], tracks, leaves
    names = [dict(zip_longest(leaves, order[: len(leaves)])) for order in permutations(tracks)]
    return max(sum(name[leaf] == track for leaf, track in pairs) for name in names) / len(pairs)


@pytest.mark.parametrize("seed", range(8))
def test_idf1(seed: int) -> None:
    truth, found = draw_labels(seed)
    assert measure(truth, found)["idf1"] == pytest.approx(best_idf1(truth, found))


def test_tracks_links_births_and_deaths() -> None:
    truth = [[1, 2], [1, 2, 3], [1, 3], [1, 3]]
    assert set(measure(truth, [[7, 8], [7, 8, 9], [7, 9], [7, 9]]).values()) == {1.0}
    measured = measure(truth, [[7, 8], [7, 8, 9], [9, 7], [9, 7]])  # 1 and 3 change places after the second date
    assert measured["short"] == pytest.approx(4 / 6)  # 1-1, 2-2, and the last step of both
    assert measured["long"] == pytest.approx(1 / 3)  # leaf 2
    assert (measured["births"], measured["deaths"]) == (1.0, 1.0)
    late = measure(truth, [[7, 8], [7, 8, 9], [7, 10], [7, 10]])
    assert late["births"] == pytest.approx(2 * 1 / (1 + 2))
    assert late["deaths"] == pytest.approx(2 * 1 / (1 + 2))
