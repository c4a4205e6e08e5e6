"""Linking leaves over all dates: the cheapest paths, and their probabilities."""

from __future__ import annotations

import networkx
import numpy as np
import pytest

from mvseg.tracking.align import Alignment
from mvseg.tracking.associate import UNLINKED, DatePair, gap_cost, link_leaves, probability

SURE = Alignment(np.eye(3), np.zeros(3), np.zeros((0, 2), int), gain=50.0, margin=50.0)
Compared = dict[tuple[int, int], DatePair]


def draw_costs(counts: list[int], seed: int) -> Compared:
    rng = np.random.default_rng(seed)
    pairs = [(a, b) for a in range(len(counts)) for b in range(a + 1, min(a + 4, len(counts)))]
    return {(a, b): DatePair(SURE, rng.normal(0, 5, (counts[a], counts[b])).round(2)) for a, b in pairs}


def least_flow(counts: list[int], compared: Compared) -> int:
    """The cost of the cheapest flow, in hundredths, with networkx: every link saves what it costs less than a cut."""
    graph = networkx.DiGraph()
    sights = [(date, row) for date, count in enumerate(counts) for row in range(count)]
    for sight in sights:
        graph.add_edge("source", ("out", sight), capacity=1, weight=0)
        graph.add_edge(("in", sight), "sink", capacity=1, weight=0)
    graph.add_edge("source", "sink", capacity=len(sights), weight=0)
    for (a, b), pair in compared.items():
        for i in range(counts[a]):
            for j in range(counts[b]):
                cost = pair.costs[i, j] + gap_cost(b - a) - UNLINKED
                graph.add_edge(("out", (a, i)), ("in", (b, j)), capacity=1, weight=round(100 * cost))
    graph.nodes["source"]["demand"], graph.nodes["sink"]["demand"] = -len(sights), len(sights)
    return int(networkx.min_cost_flow_cost(graph))


@pytest.mark.parametrize("seed", range(5))
def test_links_are_a_flow_of_least_cost(seed: int) -> None:
    counts = [3, 4, 2, 5]
    compared = draw_costs(counts, seed)
    links = link_leaves(counts, compared)
    costs = [
        compared[link.before[0], link.after[0]].costs[link.before[1], link.after[1]]
        + gap_cost(link.after[0] - link.before[0]) - UNLINKED
        for link in links
    ]  # fmt: skip
    assert round(100 * sum(costs)) == least_flow(counts, compared)
    for side in ("before", "after"):
        assert len({getattr(link, side) for link in links}) == len(links)


def test_a_hidden_leaf_is_linked_over_the_gap() -> None:
    far = np.full((1, 1), -8.0)
    compared = {
        (0, 1): DatePair(SURE, np.zeros((1, 0))),
        (1, 2): DatePair(SURE, np.zeros((0, 1))),
        (0, 2): DatePair(SURE, far),
    }
    (link,) = link_leaves([1, 0, 1], compared)
    assert (link.before, link.after) == ((0, 0), (2, 0))


def test_nothing_is_linked_across_dates_that_are_not_aligned() -> None:
    compared = {(0, 1): DatePair(SURE, np.full((2, 2), np.inf))}
    assert link_leaves([2, 2], compared) == []
    assert link_leaves([0, 0], {}) == []


def test_a_person_is_obeyed() -> None:
    compared = {(0, 1): DatePair(SURE, np.array([[-8.0, 5.0], [5.0, -8.0]]))}
    same = link_leaves([2, 2], compared, same=[((0, 0), (1, 1))])
    assert {(link.before[1], link.after[1]): link.probability for link in same} == {(0, 1): 1.0}
    different = link_leaves([2, 2], compared, different=[((0, 0), (1, 0))])
    assert [(link.before[1], link.after[1]) for link in different] == [(1, 1)]


def test_rivals_make_a_link_less_probable() -> None:
    alone, rivalled = np.array([[-5.0, 9.0]]), np.array([[-5.0, -4.0]])
    assert 0 < probability(rivalled, 0, 0) < 0.95 < probability(alone, 0, 0) < 1
