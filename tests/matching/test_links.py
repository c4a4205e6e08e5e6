"""Links of a person hold in every method, and change nothing that they agree with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links, keep_links
from mvseg.matching.match import match_regions
from mvseg.matching.one_per_view import ViewGraph
from synthetic import ball_scene

METHODS = ["nview", "one-per-view", "symnmf"]


def two_leaves() -> tuple[ViewGraph, np.ndarray]:
    """Regions 0-3 are leaf 0 in views 0-3, regions 4-7 leaf 1: weight 0.9 within a leaf, 0.1 across."""
    leaf, view = np.arange(8) // 4, np.arange(8) % 4
    weights = np.where(leaf[:, None] == leaf, 0.9, 0.1) * (view[:, None] != view)
    return ViewGraph(weights, view, 4), leaf


@pytest.mark.parametrize("method", METHODS)
def test_links_that_the_views_agree_with_change_nothing(method: str) -> None:
    scene = ball_scene(5, 6, seed=2)
    config = MatchConfig(method=method)  # type: ignore[arg-type]
    free = match_regions(scene.regions, scene.cameras, config)
    ids = free.instance_ids.tolist()
    pairs = [(a, b) for a in range(len(ids)) for b in range(a) if ids[a] > 0 and ids[b] > 0]
    links = Links.of([p for p in pairs if ids[p[0]] == ids[p[1]]], [p for p in pairs if ids[p[0]] != ids[p[1]]])
    for given in (links, Links.of(), None):
        linked = match_regions(scene.regions, scene.cameras, config, links=given)
        assert torch.equal(linked.instance_ids, free.instance_ids)
        assert torch.equal(linked.match_scores, free.match_scores)


@pytest.mark.parametrize("method", METHODS)
def test_links_against_the_views_hold_in_any_order(method: str) -> None:
    scene = ball_scene(5, 6, seed=2)
    config = MatchConfig(method=method)  # type: ignore[arg-type]
    ids = match_regions(scene.regions, scene.cameras, config).instance_ids
    one, other = ((ids == k).nonzero()[:, 0].tolist() for k in (1, 2))
    three = (ids == 3).nonzero()[:, 0].tolist()
    must, cannot = [(one[0], other[1]), (one[0], one[1])], [(three[0], three[2]), (three[1], one[0])]
    found = [
        match_regions(scene.regions, scene.cameras, config, links=links).instance_ids
        for links in (Links.of(must, cannot), Links.of([p[::-1] for p in must[::-1]], [p[::-1] for p in cannot[::-1]]))
    ]
    assert torch.equal(*found)
    for first, second in must:
        assert found[0][first] == found[0][second] > 0
    for first, second in cannot:
        assert found[0][first] != found[0][second] or found[0][first] == -1


def test_two_halves_become_one_instance() -> None:
    graph, leaf = two_leaves()
    views = np.array([0, 1, 2, 3, 4, 5, 6, 7])  # one leaf, seen as one instance in views 0-3 and as another in 4-7
    halves = ViewGraph(graph.weights, views, 8)
    assert keep_links(leaf, halves, Links.of([(1, 6)])).tolist() == [0] * 8
    assert keep_links(leaf, graph, Links.of([(1, 5)])).tolist() == [0] * 8  # pieces, in the same photos


def test_a_mask_of_the_wrong_instance_changes_alone() -> None:
    graph, leaf = two_leaves()
    wrong = leaf.copy()
    wrong[[0, 4]] = wrong[[4, 0]]
    assert keep_links(wrong, graph, Links.of([(0, 1)])).tolist() == [0, 0, 0, 0, 0, 1, 1, 1]
    assert keep_links(wrong, graph, Links.of([(0, 1), (4, 5)])).tolist() == leaf.tolist()


def test_masks_that_fit_nothing_are_an_instance_of_their_own() -> None:
    graph, leaf = two_leaves()
    weights = graph.weights.copy()
    weights[[0, 5]] = weights[:, [0, 5]] = 0.01
    lost = ViewGraph(weights, graph.view_index, 4)
    assert keep_links(leaf, lost, Links.of([(0, 5)])).tolist() == [0, 1, 1, 1, 2, 0, 2, 2]


def test_an_instance_of_two_leaves_is_divided() -> None:
    graph, leaf = two_leaves()
    both = np.zeros(8, np.int64)
    assert keep_links(both, graph, Links.of(None, [(0, 5)])).tolist() == leaf.tolist()
    three = keep_links(both, graph, Links.of(None, [(0, 5), (1, 2), (2, 5)]))
    assert len({three[0], three[5]}) == 2
    assert len({three[1], three[2], three[5]}) == 3


def test_a_mask_that_is_taken_out_finds_its_instance() -> None:
    graph, leaf = two_leaves()
    wrong = leaf.copy()
    wrong[4] = 0
    assert keep_links(wrong, graph, Links.of(None, [(4, 1)])).tolist() == leaf.tolist()


@pytest.mark.parametrize(
    ("links", "message"),
    [
        (Links.of([(0, 1), (1, 2)], [(2, 0)]), "regions 2 and 0 are the same and that they are different"),
        (Links.of([(0, 99)]), "region 99"),
    ],
)
def test_impossible_links_are_refused(links: Links, message: str) -> None:
    scene = ball_scene(3, 3, seed=2)
    with pytest.raises(InputError, match=message):
        match_regions(scene.regions, scene.cameras, links=links)
