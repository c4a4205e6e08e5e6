"""Symmetric best Dice and counts: the challenge's definition on label maps, and cases with a known answer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.best_dice import count_and_dice
from mvseg.evaluation.average_precision import describe_mask


def annotate(labels: np.ndarray, image_id: int = 0, score: float | None = None) -> list[dict[str, Any]]:
    extra: dict[str, Any] = {"iscrowd": 0, "category_id": 1} | ({} if score is None else {"score": score})
    ids = np.unique(labels[labels > 0]).tolist()
    return [describe_mask(torch.from_numpy(labels == number), image_id) | extra for number in ids]


def best_dice(first: np.ndarray, second: np.ndarray) -> float:
    """Eq. 2 of Scharr et al., pixel by pixel."""
    means = []
    for number in np.unique(first[first > 0]):
        a = first == number
        others = [second == other for other in np.unique(second[second > 0])]
        means.append(max(2 * np.sum(a & b) / (np.sum(a) + np.sum(b)) for b in others))
    return float(np.mean(means))


@pytest.mark.parametrize("seed", range(5))
def test_twin_on_label_maps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, found = (np.kron(rng.integers(0, 6, (5, 5)), np.ones((3, 4), int)) for _ in range(2))
    measured = count_and_dice(annotate(true), annotate(found, score=0.9), 1, min_score=0.5)
    assert measured["sbd"] == pytest.approx(min(best_dice(true, found), best_dice(found, true)))
    assert measured["count_difference"] == len(np.unique(found[found > 0])) - len(np.unique(true[true > 0]))


def test_a_leaf_in_two_halves() -> None:
    true, halves = np.ones((4, 8), int), np.ones((4, 8), int)
    halves[:, 4:] = 2
    measured = count_and_dice(annotate(true), annotate(halves, score=0.9), 1, min_score=0.5)
    assert measured == pytest.approx({"sbd": 2 / 3, "count_difference": 1, "absolute_count_difference": 1})


def test_counts_of_photos_do_not_make_up_for_each_other() -> None:
    one, two = np.ones((4, 8), int), np.repeat([[1, 1, 1, 1, 2, 2, 2, 2]], 4, 0)
    truth = annotate(one, 0) + annotate(two, 1)
    found = annotate(two, 0, 0.9) + annotate(one, 1, 0.9)
    measured = count_and_dice(truth, found, 2, min_score=0.5)
    assert (measured["count_difference"], measured["absolute_count_difference"]) == (0, 1)


def test_low_scores_crowds_and_empty_photos() -> None:
    leaf = np.ones((4, 8), int)
    crowd = [{**annotation, "iscrowd": 1} for annotation in annotate(leaf, 1)]
    truth = annotate(leaf, 0) + crowd
    low = annotate(leaf, 0, 0.4)
    assert count_and_dice(truth, low, 2, min_score=0.3)["sbd"] == 1  # nothing in photo 1, and nothing found there
    assert count_and_dice(truth, low, 2, min_score=0.5)["sbd"] == 0.5
    assert count_and_dice(truth, low, 2, min_score=0.5)["count_difference"] == -0.5
    with pytest.raises(ValueError, match="no images"):
        count_and_dice([], [], 0, min_score=0.5)
