from __future__ import annotations

from itertools import combinations

import pytest

from mvseg.poses.features import FEW, OVERLAP, choose_pairs


def names(num_photos: int, folder: str = "") -> list[str]:
    return [f"{folder}{index:03d}.jpg" for index in range(num_photos)]


@pytest.mark.parametrize(("num_photos", "how"), [(3, None), (FEW, None), (FEW + 20, "exhaustive")])
def test_all_pairs(num_photos: int, how) -> None:
    assert choose_pairs(names(num_photos), how) == list(combinations(range(num_photos), 2))


@pytest.mark.parametrize("num_photos", [FEW + 1, 100, 301])
def test_a_sequence_is_a_ring(num_photos: int) -> None:
    """Every photo has the same neighbours: the pairs are those of photo 0, moved on."""
    pairs = choose_pairs(names(num_photos))
    assert len(set(pairs)) == len(pairs) < num_photos * (OVERLAP + 5)
    assert all(i < j for i, j in pairs)
    steps = {j for i, j in pairs if i == 0}
    assert set(range(1, OVERLAP + 1)) <= steps
    assert num_photos - 1 in steps
    assert max(min(step, num_photos - step) for step in steps) > num_photos / 4  # across the ring
    moved = {tuple(sorted((i, (i + step) % num_photos))) for i in range(num_photos) for step in steps}
    assert moved == set(pairs)


def test_cameras_that_take_turns_are_neighbours() -> None:
    pairs = set(choose_pairs([*names(60, "side/"), *names(30, "top/")], "sequential"))
    assert {(0, 1), (0, 59), (60, 61), (60, 89), (0, 60), (58, 89)} <= pairs  # side 58 is near top 29
    assert len(pairs) < 90 * 89 / 2 * 0.6


@pytest.mark.parametrize("num_photos", [3, 4, 15])
def test_short_sequences_are_all_pairs(num_photos: int) -> None:
    assert choose_pairs(names(num_photos), "sequential") == list(combinations(range(num_photos), 2))
