"""Links of a person hold in every method, and change nothing that they agree with."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.label_maps import render_maps
from mvseg.errors import InputError, InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links
from mvseg.matching.match import match_regions
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.plane_sweep import sweep_planes
from mvseg.matching.nview.search import search
from mvseg.matching.one_per_view import link_average, one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import ViewGraph
from mvseg.simulation.dataset import SceneSpec
from reference import link_average_reference
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


def clusters_of(graph: ViewGraph, links: Links) -> list[int]:
    found: list[int] = one_per_view_clusters(replace(graph, links=links)).ids.tolist()
    return found


def test_average_linkage_is_that_of_the_contracted_graph() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views = rng.integers(0, 6, 16)
        W = rng.random((16, 16))
        W = (W + W.T) / 2 * (views[:, None] != views)
        must = [(n, int(rng.integers(16))) for n in range(3)]
        node = Links.of(must).components(16)
        cannot = [(a, b) for a, b in rng.integers(0, 16, (4, 2)).tolist() if node[a] != node[b]]
        links = Links.of(must, cannot)
        linked = link_average(ViewGraph(W, views, 6, links), 0.3)
        np.testing.assert_array_equal(linked.ids, Clusters.of(link_average_reference(W, views, 0.3, links)).ids)
        assert links.agree(linked)


@pytest.mark.parametrize("seed", range(6))
def test_the_order_of_regions_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views, W = rng.integers(0, 5, 20), rng.random((20, 20))
    must = [(int(a), int(b)) for a, b in rng.integers(0, 20, (3, 2))]
    node = Links.of(must).components(20)
    links = Links.of(must, [(a, b) for a, b in rng.integers(0, 20, (5, 2)).tolist() if node[a] != node[b]])
    graph = ViewGraph((W + W.T) / 2 * (views[:, None] != views), views, 5, links)
    found, order = one_per_view_clusters(graph), rng.permutation(20)
    assert links.agree(found)
    np.testing.assert_array_equal(one_per_view_clusters(graph.select(order)).ids, Clusters.of(found.ids[order]).ids)


def test_nodes_of_one_region_are_no_links_to_the_bit() -> None:
    """The way through nodes is the plain one where each region is a node, in the whole search."""
    scene = ball_scene(6, 6, seed=4)
    regions = scene.regions.select(scene.regions.view_index.argsort(stable=True))
    affinity = region_affinity(regions, scene.cameras)
    weights = affinity.to_dense().double().numpy()
    weights[3] = weights[:, 3] = 0  # not too easy
    graph = ViewGraph(weights, regions.view_index.numpy(), 6)
    trivial = replace(graph, links=Links.of([(0, 0)]))
    pairwise = one_per_view_clusters(graph)
    np.testing.assert_array_equal(pairwise.ids, one_per_view_clusters(trivial).ids)
    table = sweep_planes(regions, scene.cameras)
    found = [search(ClusterScores(table, each), pairwise).ids for each in (graph, trivial)]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(2))
def test_links_are_never_violated(method: str, seed: int) -> None:
    """Whatever a person says, right or wrong, in any order of regions."""
    scene = ball_scene(4, 5, seed=seed)
    rng = np.random.default_rng(seed)
    num = len(scene.regions)
    must = [(int(a), int(b)) for a, b in rng.integers(0, num, (3, 2)) if a != b]
    node = Links.of(must).components(num)
    links = Links.of(must, [(int(a), int(b)) for a, b in rng.integers(0, num, (4, 2)) if node[a] != node[b]])
    config = MatchConfig(method=method, num_instances=3 if method == "symnmf" else None)  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # views that do not agree: these links are nonsense
        ids = match_regions(scene.regions, scene.cameras, config, links=links).instance_ids
        assert links.agree(Clusters.of(ids.numpy()))
        if method != "nview":  # SymNMF's random starts depend on the order, and weights of 1 tie
            return
        order = torch.from_numpy(rng.permutation(num))
        moved = match_regions(scene.regions.select(order), scene.cameras, config, links=links.select(order))
    np.testing.assert_array_equal(*(Clusters.of(each.numpy()).ids for each in (moved.instance_ids, ids[order])))


def test_a_contracted_graph_is_exact_for_symnmf() -> None:
    """|W - H H^T|^2 of any H with equal rows in a node differs from that of the contracted graph by a constant."""
    rng = np.random.default_rng(0)
    W = rng.random((7, 7))
    graph = ViewGraph(W + W.T, np.arange(7), 7, Links.of([(0, 2), (1, 4), (4, 5)]))
    assert graph.node.tolist() == [0, 1, 0, 2, 1, 1, 3]
    small, differences = graph.contract(), []
    for _ in range(4):
        rows = rng.random((4, 3))
        H, G = rows[graph.node], rows * np.sqrt(np.bincount(graph.node))[:, None]
        differences.append(np.square(graph.weights - H @ H.T).sum() - np.square(small - G @ G.T).sum())
    np.testing.assert_allclose(differences, differences[0])


def test_clusters_that_contradict_links_are_parted_at_the_least_cost() -> None:
    """Regions 0 to 3 are one cluster, 4 is in none; region 2 fits worst."""
    weights = np.full((6, 6), 0.9)
    weights[2] = weights[:, 2] = 0.5
    found = Clusters.of(np.array([0, 0, 0, 0, -1, -1]))

    def parted(links: Links) -> list[int]:
        ids: list[int] = ViewGraph(weights, np.arange(6), 6, links).part(found).ids.tolist()
        return ids

    assert parted(Links.of()) == found.ids.tolist()
    assert parted(Links.of(None, [(0, 2), (4, 5)])) == [0, 0, 1, 0, -1, -1]
    assert parted(Links.of(None, [(0, 2), (2, 3)])) == [0, 0, 1, 0, -1, -1]
    assert parted(Links.of([(0, 2)], [(1, 2)])) == [0, 1, 0, 1, -1, -1]  # those that must be together leave together
    assert parted(Links.of([(4, 5)])) == [0, 0, 0, 0, 1, 1]  # none fits them, but they are one


def test_a_mask_of_the_wrong_instance_changes_alone() -> None:
    """Without links, ties of views 0 and 4 would leave the masks where they are."""
    graph, _ = two_leaves()
    weights = graph.weights.copy()
    weights[0, 1:4] = weights[1:4, 0] = weights[4, 5:] = weights[5:, 4] = 0.1
    weights[0, 5:] = weights[5:, 0] = weights[4, 1:4] = weights[1:4, 4] = 0.3
    wrong = ViewGraph(weights, graph.view_index, 4)
    assert clusters_of(wrong, Links.of()) == [0, 1, 1, 1, 1, 0, 0, 0]
    assert clusters_of(wrong, Links.of([(0, 1)])) == [0, 0, 0, 0, 1, 1, 1, 1]


def test_an_instance_of_two_leaves_is_divided_and_pieces_in_one_photo_are_one() -> None:
    leaf, view = np.arange(8) // 4, np.arange(8)
    graph = ViewGraph(np.where(leaf[:, None] == leaf, 0.9, 0.4) * (view[:, None] != view), view, 8)
    assert clusters_of(graph, Links.of()) == [0] * 8
    assert clusters_of(graph, Links.of(None, [(0, 5)])) == [0, 0, 0, 0, 1, 1, 1, 1]
    graph, _ = two_leaves()
    found = clusters_of(graph, Links.of([(1, 5)]))
    assert found[1] == found[5]


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


def test_a_link_sets_other_masks_right_too() -> None:
    """On the masks of a faulty segmenter: one mask is linked to its leaf, and the others gain by it."""
    spec = SceneSpec(folder="", split="dev", family="lobed", num_leaves=32, num_views=5, seed=3859390669)
    scene = render_maps(spec)
    regions, truth = scene.masks("degraded")
    free, links = match_regions(regions, scene.cameras).instance_ids, []
    for leaf in truth[truth > 0].unique().tolist():
        own = (truth == leaf).nonzero()[:, 0]
        main = own[free[own] == free[own][free[own] > 0].mode()[0]]
        links += [(int(main[0]), wrong) for wrong in own[free[own] != free[main[0]]].tolist()]
    gains = []
    for right, wrong in links[:2]:
        linked = match_regions(regions, scene.cameras, links=Links.of([(right, wrong)])).instance_ids
        others = (truth > 0) & (torch.arange(len(truth)) != wrong)
        gained, was = (matching_metrics(ids[others], truth[others]).ari for ids in (linked, free))
        gains.append(gained - was)
    assert np.mean(gains) > 0.01
