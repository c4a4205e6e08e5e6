from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.pairs import choose_pairs, pairs_with


def names(num_photos: int, folder: str = "") -> list[str]:
    return [f"{folder}{index:03d}.jpg" for index in range(num_photos)]


@pytest.mark.parametrize(("num_photos", "how"), [(3, None), (STRUCTURE.few, None), (STRUCTURE.few + 20, "exhaustive")])
def test_all_pairs(num_photos: int, how) -> None:
    assert choose_pairs(names(num_photos), how) == list(combinations(range(num_photos), 2))


@pytest.mark.parametrize("num_photos", [STRUCTURE.few + 1, 100, 301])
def test_a_sequence_is_a_ring(num_photos: int) -> None:
    """Every photo has the same neighbours: the pairs are those of photo 0, moved on."""
    pairs = choose_pairs(names(num_photos))
    assert len(set(pairs)) == len(pairs) < num_photos * (STRUCTURE.overlap + 6)
    assert all(i < j for i, j in pairs)
    steps = {j for i, j in pairs if i == 0}
    assert set(range(1, STRUCTURE.overlap + 1)) <= steps
    assert num_photos - 1 in steps
    assert max(min(step, num_photos - step) for step in steps) > num_photos / 4  # across the ring
    moved = {tuple(sorted((i, (i + step) % num_photos))) for i in range(num_photos) for step in steps}
    assert moved == set(pairs)


def test_cameras_that_take_turns_are_neighbours() -> None:
    pairs = set(choose_pairs([*names(60, "side/"), *names(30, "top/")], "sequential"))
    assert {(0, 1), (0, 59), (60, 61), (60, 89), (0, 60), (58, 89)} <= pairs  # side 58 is near top 29
    assert len(pairs) < 90 * 89 / 2 * 0.6


@pytest.mark.parametrize("num_photos", [3, 4, 2 * STRUCTURE.overlap + 1])
def test_short_sequences_are_all_pairs(num_photos: int) -> None:
    assert choose_pairs(names(num_photos), "sequential") == list(combinations(range(num_photos), 2))


def look(num_photos: int, seed: int = 0) -> np.ndarray:
    """How alike photos could be: symmetric, 0 on the diagonal, mostly below what counts."""
    upper = np.triu(np.random.default_rng(seed).poisson(4, (num_photos, num_photos)), 1)
    return upper + upper.T


@pytest.mark.parametrize("num_photos", [2, STRUCTURE.few, STRUCTURE.few + 1, 46, 120])
@pytest.mark.parametrize("how", [None, "sequential", "exhaustive"])
def test_laws_of_pairs(num_photos: int, how) -> None:
    """Each pair once and in order, none of a photo with itself, no photo without a pair."""
    pairs = choose_pairs(names(num_photos), how, alike=look(num_photos))
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < num_photos for i, j in pairs)
    assert {each for pair in pairs for each in pair} == set(range(num_photos))


def test_photos_that_look_alike_are_compared_wherever_they_are() -> None:
    num_photos = 60
    plain = set(choose_pairs(names(num_photos)))
    alike = np.zeros((num_photos, num_photos), np.int64)
    for i, j, count in ((3, 30, 40), (12, 41, STRUCTURE.least_alike), (5, 50, STRUCTURE.least_alike - 1)):
        alike[i, j] = alike[j, i] = count
    assert set(choose_pairs(names(num_photos), alike=alike)) - plain == {(3, 30), (12, 41)}
    assert set(choose_pairs(names(num_photos), "sequential", alike=alike)) == plain  # only what was asked for


def test_each_photo_chooses_so_many_and_neighbours_do_not_count() -> None:
    num_photos = 100
    plain = set(choose_pairs(names(num_photos)))
    everything = np.full((num_photos, num_photos), 50, np.int64)
    np.fill_diagonal(everything, 0)
    added = set(choose_pairs(names(num_photos), alike=everything)) - plain
    assert num_photos * STRUCTURE.most_alike / 2 <= len(added) <= num_photos * STRUCTURE.most_alike
    chosen = np.bincount(np.array(sorted(added)).ravel(), minlength=num_photos)
    assert chosen.min() >= STRUCTURE.most_alike


@pytest.mark.parametrize("seed", range(3))
def test_the_order_does_not_matter_where_looks_tell(seed: int) -> None:
    """A walk in disorder: its neighbours are found by their looks, and stay pairs."""
    num_photos = 50
    place = np.random.default_rng(seed).permutation(num_photos)
    apart = np.abs(place[:, None] - place[None])
    alike = np.where(apart <= 3, 60 - 15 * apart, 2) * (apart > 0)
    pairs = set(choose_pairs(names(num_photos), alike=alike))
    neighbours = {(i, j) for i, j in combinations(range(num_photos), 2) if apart[i, j] <= 3}
    assert neighbours <= pairs


def test_pairs_with_photos_that_were_left_out() -> None:
    assert pairs_with([2, 0], 4) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]
    assert pairs_with([], 4) == []
    assert pairs_with(range(6), 6) == list(combinations(range(6), 2))
