from __future__ import annotations

import numpy as np
import pytest

from benchmarks.faults import Faults, degrade_labels
from mvseg.errors import InputError

NONE = Faults(missed=0, merged=0, split=0, blur_px=0)


def two_touching() -> np.ndarray:
    labels = np.zeros((60, 80), np.uint16)
    labels[10:40, 10:30] = 7
    labels[10:40, 30:50] = 3
    labels[50:58, 60:78] = 9
    return labels


def partition(labels: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(labels == number).tolist()) for number in np.unique(labels) if number}


def test_no_faults_keep_the_masks() -> None:
    assert partition(degrade_labels(two_touching(), NONE, seed=0)) == partition(two_touching())


def test_same_seed_same_faults() -> None:
    first, second, other = (degrade_labels(two_touching(), Faults(), seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


def test_all_missed() -> None:
    assert not degrade_labels(two_touching(), Faults(missed=1), seed=0).any()


def test_only_touching_masks_merge() -> None:
    labels = two_touching()
    merged = degrade_labels(labels, Faults(missed=0, merged=1, split=0, blur_px=0), seed=0)
    together = frozenset(np.flatnonzero((labels == 7) | (labels == 3)).tolist())
    assert partition(merged) == {together, frozenset(np.flatnonzero(labels == 9).tolist())}


def test_a_split_cuts_across_the_long_axis_into_parts_of_a_quarter_or_more() -> None:
    labels = np.zeros((50, 200), np.uint16)
    labels[20:30, 20:180] = 1
    parts = partition(degrade_labels(labels, Faults(missed=0, merged=0, split=1, blur_px=0), seed=1))
    assert len(parts) == 2
    assert frozenset.union(*parts) == frozenset(np.flatnonzero(labels).tolist())
    columns = sorted({pixel % 200 for pixel in part} for part in parts)
    assert max(min(columns, key=min)) <= min(max(columns, key=min))  # they share a column of pixels at most
    assert min(len(part) for part in parts) >= 0.24 * 1600


def test_outlines_move_by_one_to_three_pixels() -> None:
    labels = np.zeros((100, 100), np.uint16)
    labels[30:70, 30:70] = 1
    widths = set()
    for seed in range(40):
        rows = np.flatnonzero(degrade_labels(labels, Faults(missed=0, merged=0, split=0), seed=seed).any(1))
        widths.add(int(rows[-1] - rows[0] + 1))
    assert widths == {34, 36, 38, 42, 44, 46}


def test_erosion_spares_thin_blades_and_small_masks_are_discarded() -> None:
    labels = np.zeros((40, 100), np.uint16)
    labels[10:13, 5:95] = 1
    labels[30:33, 5:14] = 2
    for seed in range(10):
        parts = partition(degrade_labels(labels, Faults(missed=0, merged=0, split=0, min_pixels=100), seed=seed))
        assert all(len(part) >= 100 for part in parts)
        assert any(part & set(np.flatnonzero(labels == 1)) for part in parts)


def test_empty_frame() -> None:
    assert not degrade_labels(np.zeros((5, 5), np.uint16), Faults(), seed=0).any()


def test_impossible_faults_are_refused() -> None:
    with pytest.raises(InputError, match=r"split masks is 1\.5"):
        Faults(split=1.5)
    with pytest.raises(InputError, match="blur_px -1"):
        Faults(blur_px=-1)
