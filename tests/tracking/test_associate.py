"""Joining the sights of leaves over all dates, against all ways to do so; and how dates hold each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.tracking.align import make_poses
from mvseg.tracking.associate import Association, join_observations, link_leaves
from mvseg.tracking.numbers import LINKING
from mvseg.tracking.place_dates import chain_dates

Costs = dict[tuple[int, int], np.ndarray]


def draw_gains(counts: list[int], seed: int, *, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gains of sights of leaves that are seen by chance, the date of each, and the leaf."""
    rng = np.random.default_rng(seed)
    date_of = np.repeat(np.arange(len(counts)), counts)
    leaf = np.concatenate([rng.permutation(max(counts))[:count] for count in counts])
    same = leaf[:, None] == leaf
    gains = np.where(same, 3.0, -3.0) + rng.normal(0, noise, same.shape)
    gains[date_of[:, None] == date_of] = 0
    return gains + gains.T, date_of, leaf


def every_partition(date_of: np.ndarray) -> Iterator[list[int]]:
    """All ways to part sights into tracks, none with two of a date."""

    def extend(tracks: list[int]) -> Iterator[list[int]]:
        if len(tracks) == len(date_of):
            yield tracks
            return
        taken = {track for track, date in zip(tracks, date_of, strict=False) if date == date_of[len(tracks)]}
        for track in sorted({*tracks, max(tracks, default=-1) + 1} - taken):
            yield from extend([*tracks, track])

    return extend([])


def gain_of(tracks: np.ndarray | list[int], gains: np.ndarray) -> float:
    together = np.asarray(tracks)[:, None] == np.asarray(tracks)
    return float(gains[together].sum() / 2)


@pytest.mark.parametrize("seed", range(6))
def test_no_parting_is_better(seed: int) -> None:
    gains, date_of, _ = draw_gains([2, 3, 2, 2], seed, noise=3.0)
    best = max(gain_of(tracks, gains) for tracks in every_partition(date_of))
    found = join_observations(gains, date_of, np.zeros(len(gains), bool))
    assert gain_of(found, gains) == pytest.approx(best, rel=0.02)
    for date in range(4):
        assert len(set(found[date_of == date])) == (date_of == date).sum()


def test_leaves_that_are_alike_are_one_track() -> None:
    gains, date_of, leaf = draw_gains([5, 7, 6, 7, 4], 3, noise=0.5)
    tracks = join_observations(gains, date_of, np.zeros(len(gains), bool))
    assert ((tracks[:, None] == tracks) == (leaf[:, None] == leaf)).all()


def pairs_of(links: list[Association]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    return [(link.before, link.after) for link in links]


def test_dates_around_outweigh_one_on_which_two_leaves_look_swapped() -> None:
    alike, odd = np.array([[-8.0, 5.0], [5.0, -8.0]]), np.array([[1.0, -1.0], [-1.0, 1.0]])
    costs: Costs = {(0, 1): odd, (1, 2): alike, (0, 2): 2 * alike}
    assert ((0, 0), (1, 0)) in pairs_of(link_leaves([2, 2, 2], costs))
    assert ((0, 0), (1, 1)) in pairs_of(link_leaves([2, 2], {(0, 1): odd}))


def test_a_rolled_leaf_goes_on_as_the_leaf_that_it_opens_to() -> None:
    """As on an oil palm, whose next spear stands where the last one stood."""
    both = np.array([[1.0, -6.0]])
    costs: Costs = {(0, 1): np.array([[-9.0]]), (1, 2): both, (0, 2): both}
    opened, spear = ((1, 0), (2, 0)), ((1, 0), (2, 1))
    assert pairs_of(link_leaves([1, 1, 2], costs)) == [((0, 0), (1, 0)), spear]
    for is_rolled in (False, True):  # on the first date
        doubted = np.array([is_rolled, False, False, True])
        assert pairs_of(link_leaves([1, 1, 2], costs, doubted=doubted)) == [((0, 0), (1, 0)), opened]
    assert pairs_of(link_leaves([1, 1, 2], costs, same=[spear], doubted=doubted)) == [((0, 0), (1, 0)), spear]
    assert len(link_leaves([1, 1], {(0, 1): costs[0, 1]}, doubted=np.array([False, True]))) == 1  # none else


def test_nothing_is_linked_across_dates_that_are_not_aligned() -> None:
    assert link_leaves([2, 2], {}) == []
    assert link_leaves([0, 0], {}) == []
    assert link_leaves([1, 1], {(0, 1): np.full((1, 1), LINKING.unlinked + 0.1)}) == []


def test_a_person_is_obeyed() -> None:
    costs: Costs = {(0, 1): np.array([[-8.0, 5.0], [5.0, -8.0]])}
    same = link_leaves([2, 2], costs, same=[((0, 0), (1, 1))])
    assert {(link.before[1], link.after[1]): link.probability for link in same} == {(0, 1): 1.0}
    different = link_leaves([2, 2], costs, different=[((0, 0), (1, 0))])
    assert [(link.before[1], link.after[1]) for link in different] == [(1, 1)]
    with pytest.raises(InputError, match="contradicts itself"):
        link_leaves([1, 2], {}, same=[((0, 0), (1, 0)), ((0, 0), (1, 1))])


def test_rivals_make_a_link_less_probable() -> None:
    (alone,), (rivalled, *_) = (link_leaves([1, 2], {(0, 1): np.array([row])}) for row in ([-9.0, 9.0], [-9.0, -8.5]))
    assert 0.97 < alone.probability < 1
    assert 1 - rivalled.probability > 20 * (1 - alone.probability)


def test_dates_stand_as_the_likeliest_alignments_say() -> None:
    shifts = {(0, 1): -1.0, (1, 2): -1.0, (0, 2): 9.0, (2, 3): 5.0}
    steps = {pair: make_poses(np.eye(3), np.array([x, 0, 0])) for pair, x in shifts.items()}
    poses, roots = chain_dates(5, steps, {(0, 1): 0.9, (1, 2): 0.9, (0, 2): 0.8, (2, 3): 0.2})
    np.testing.assert_allclose(poses[:, 0, 3], [0, 1, 2, -3, 0])
    assert roots.tolist() == [0, 0, 0, 0, 4]
