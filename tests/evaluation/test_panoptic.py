"""Whole leaves, misses and false leaves included, against counting sets of pixels."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import torch

from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.evaluation.panoptic import compare_annotators, leaf_metrics
from mvseg.regions import Regions, regions_from_label_maps, stack_regions
from reference import leaf_metrics_reference

SIZE = 12
IGNORE = 65535


def random_truth(rng: np.random.Generator, *, num_views: int = 3, num_leaves: int = 4) -> list[np.ndarray]:
    """Label maps of rectangles, the later on top, with an ignored one in some."""
    maps = []
    for _ in range(num_views):
        labels = np.zeros((SIZE, SIZE), np.int64)
        for leaf in [*range(1, num_leaves + 1), *([IGNORE] if rng.random() < 0.7 else [])]:
            if rng.random() < 0.8:
                labels[random_window(rng)] = leaf
        maps.append(labels)
    return maps


def random_window(rng: np.random.Generator) -> tuple[slice, slice]:
    (top, left), (height, width) = rng.integers(0, SIZE - 5, 2), rng.integers(2, 7, 2)
    return slice(top, top + height), slice(left, left + width)


def random_estimate(
    rng: np.random.Generator, truth: list[np.ndarray]
) -> tuple[list[tuple[int, np.ndarray]], list[int]]:
    """Masks near the true ones and elsewhere, which overlap, and ids that are mostly right; one id may have two masks
    in a view."""
    masks, ids = [], []
    for view, labels in enumerate(truth):
        for leaf in set(labels.ravel().tolist()) - {0}:
            mask = np.roll(labels == leaf, rng.integers(0, 2), axis=int(rng.integers(2)))
            masks.append((view, mask))
            ids.append(int(rng.choice([leaf % 7, leaf % 7, leaf % 7, 2, -1])))
        stray = np.zeros((SIZE, SIZE), bool)
        stray[random_window(rng)] = True
        masks.append((view, stray))
        ids.append(int(rng.choice([-1, 1, 9])))
    return masks, ids


def stack(masks: list[tuple[int, np.ndarray]], num_views: int) -> Regions:
    """Regions whose crops are whole frames."""
    rows = [(view, Crop((0, 0, mask.shape[1], mask.shape[0]), torch.from_numpy(mask)), 0) for view, mask in masks]
    return stack_regions(rows, num_views)


@pytest.mark.parametrize("seed", range(40))
def test_it_counts_as_sets_of_pixels_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    masks, ids = random_estimate(rng, truth)
    expected = leaf_metrics_reference(masks, ids, truth)
    assert asdict(leaf_metrics(stack(masks, 3), torch.tensor(ids), truth)) == pytest.approx(expected)


def perfect(truth: list[np.ndarray]) -> tuple[Regions, torch.Tensor]:
    regions = regions_from_label_maps(truth)
    return regions, regions.labels


def test_a_leaf_in_two_halves_or_under_two_ids_is_not_right() -> None:
    truth = [np.repeat([[1, 1, 2, 2]], 4, 0)] * 2
    regions, _ = perfect(truth)
    swapped = torch.tensor([1, 2, 2, 1])  # every mask is right, every id is right in one view of two: IoU 1/3
    metrics = leaf_metrics(regions, swapped, truth)
    assert (metrics.mask_precision, metrics.mask_recall, metrics.all_pair_f1, metrics.mv_pq) == (1, 1, 0, 0)
    halves = regions_from_label_maps([np.repeat([[1, 5, 2, 2]], 4, 0)] * 2)
    assert leaf_metrics(halves, halves.labels, truth).mv_pq == pytest.approx(1 / (1 + 2 / 2 + 1 / 2))


def test_misses_and_false_leaves_cost_half_each() -> None:
    truth = [np.array([[1, 0, 2, 0, 3]])]
    regions = regions_from_label_maps([np.array([[1, 7, 2, 0, 0]])])
    metrics = leaf_metrics(regions, torch.tensor([-1, -1, -1]), truth)
    assert metrics.mv_pq == pytest.approx(2 / (2 + 1 / 2 + 1 / 2))
    assert (metrics.num_right, metrics.num_false, metrics.num_missed) == (2, 1, 1)
    assert (metrics.mask_precision, metrics.mask_recall) == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    nothing, leaf = [np.zeros((2, 3), int)], [np.array([[0, 4, 4]])]
    none = regions_from_label_maps(nothing)
    assert leaf_metrics(none, none.labels, nothing).mv_pq == 1
    missed = leaf_metrics(none, none.labels, leaf)
    assert (missed.mask_precision, missed.mask_recall, missed.mv_pq, missed.num_missed) == (1, 0, 0, 1)
    false = leaf_metrics(*perfect(leaf), [np.zeros((1, 3), int)])
    assert (false.mask_precision, false.mask_recall, false.mv_pq, false.num_false) == (0, 1, 0, 1)


def test_other_numbers_of_ids_or_maps() -> None:
    truth = [np.array([[0, 4, 4]])]
    regions, ids = perfect(truth)
    with pytest.raises(InputError, match="0 ids and 1 true label maps, expected 1 and 1"):
        leaf_metrics(regions, ids[:0], truth)
    with pytest.raises(InputError, match="1 ids and 2 true label maps"):
        leaf_metrics(regions, ids, truth * 2)


LEFT, RIGHT, BELOW = (slice(0, 10), slice(0, 10)), (slice(0, 10), slice(10, 20)), (slice(10, 20), slice(0, 10))


def drawn(*views: dict[int, tuple[slice, slice]]) -> list[np.ndarray]:
    maps = []
    for leaves in views:
        maps.append(np.zeros((20, 20), np.int64))
        for leaf, place in leaves.items():
            maps[-1][place] = leaf
    return maps


def test_leaves_of_two_annotators_are_named_by_both() -> None:
    """One has drawn leaf 7 over eight of ten rows, has put one mask of it to another leaf, and a leaf of his own."""
    rows = (slice(0, 8), slice(0, 10))
    one = drawn({3: rows, 4: RIGHT}, {3: rows, 4: RIGHT}, {3: rows, 4: RIGHT}, {4: rows, 9: BELOW})
    other = drawn({7: LEFT, 5: RIGHT}, {7: LEFT, 5: RIGHT}, {7: LEFT, 5: RIGHT}, {7: LEFT, 6: RIGHT})
    regions = regions_from_label_maps(one)
    found = compare_annotators(regions, regions.labels, other)
    assert found.shared == ((3, 7, 3 * 80 / 400), (4, 5, 300 / 380))
    assert (found.alone, found.missed) == ((9,), (6,))
    back = regions_from_label_maps(other)
    again = compare_annotators(back, back.labels, one)
    assert [(true, leaf) for leaf, true, _ in again.shared] == [(4, 5), (3, 7)]
    unmatched = torch.where(regions.labels == 9, -1, regions.labels)
    assert compare_annotators(regions, unmatched, other).alone == ()
