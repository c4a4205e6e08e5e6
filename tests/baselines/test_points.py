from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.baselines.points import centroid_rays, match_points, nearest_ray_graph, pairwise_ray_distance
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import Affinity
from mvseg.matching.config import MatchConfig
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras, Scene, View
from reference import ray_distance_reference
from synthetic import BallScene, ball_scene, moved, permute_views


def scene_of(cameras: Cameras) -> Scene:
    return Scene("balls", tuple(View(str(view), Path(f"{view}.png")) for view in range(len(cameras))), cameras)


@pytest.fixture(scope="module")
def balls() -> BallScene:
    return ball_scene(4, 10, seed=1)


def edge_set(graph: Affinity) -> set[tuple[int, int]]:
    return {(n, m) for n, m in graph.edges.tolist()}


def test_finds_the_balls_of_an_easy_scene(balls: BallScene) -> None:
    found = match_points(balls.regions, scene_of(balls.cameras))
    assert matching_metrics(found.instance_ids, balls.regions.labels).ari == 1
    assert (found.num_instances, found.report.method) == (4, "points")
    assert found.match_scores.dtype == torch.float32
    assert found.match_scores.min() > 0.8
    assert found.match_scores.max() <= 1


def test_number_range_and_seed_are_respected(balls: BallScene) -> None:
    scene = scene_of(balls.cameras)
    assert match_points(balls.regions, scene, MatchConfig(num_instances=2)).num_instances == 2
    assert match_points(balls.regions, scene, MatchConfig(search_range=(6, 6))).num_instances >= 5
    runs = [match_points(balls.regions, scene, MatchConfig(search_range=(6, 6), seed=seed)) for seed in (0, 0, 5)]
    assert torch.equal(runs[0].instance_ids, runs[1].instance_ids)
    assert not torch.equal(runs[0].instance_ids, runs[2].instance_ids)


def test_distance_is_that_of_the_slow_twin() -> None:
    generator = torch.Generator().manual_seed(0)
    origins, rays = (torch.randn(2, 12, 3, generator=generator).double() for _ in range(2))
    rays = torch.nn.functional.normalize(rays, dim=2)
    fast = pairwise_ray_distance((origins[0], rays[0]), (origins[1], rays[1]))
    assert fast.isfinite().sum() not in (0, fast.numel())
    torch.testing.assert_close(fast, ray_distance_reference((origins[0], rays[0]), (origins[1], rays[1])))


def test_distance_of_special_rays() -> None:
    def ray(origin: list[float], direction: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor([origin]).double(), torch.tensor([direction]).double()

    ahead = ray([0, 0, 0], [0, 0, 1])
    assert pairwise_ray_distance(ahead, ray([3, 0, -5], [0, 0, 1])).item() == 3  # parallel
    assert pairwise_ray_distance(ahead, ray([3, 0, 5], [0, 0, -1])).item() == torch.inf  # nowhere nearest
    assert pairwise_ray_distance(ahead, ray([3, 2, 5], [-1, 0, 0])).item() == 2
    assert pairwise_ray_distance(ahead, ray([3, 2, -5], [-1, 0, 0])).item() == torch.inf  # behind
    assert pairwise_ray_distance(ahead, ray([3, 2, 5], [torch.nan, 0, 0])).item() == torch.inf


def test_rays_pass_the_centroids(balls: BallScene) -> None:
    origins, rays = centroid_rays(balls.regions, balls.cameras)
    for index in (0, 7, 21):
        view = int(balls.regions.view_index[index])
        rows, columns = balls.regions.crop(index).nonzero().double().mean(0) + 0.5
        expected = torch.stack((columns, rows)) + balls.regions.boxes[index, :2]
        pixels, _ = balls.cameras.project((origins[index] + 3 * rays[index])[None])
        torch.testing.assert_close(pixels[view, 0], expected)


def test_graph_is_that_of_nearest_rays_one_region_at_a_time(balls: BallScene) -> None:
    origins, rays = centroid_rays(balls.regions, balls.cameras)
    distance, view = ray_distance_reference((origins, rays), (origins, rays)), balls.regions.view_index
    expected = set()
    for n in range(len(view)):
        for j in set(view.tolist()) - {int(view[n])}:
            m = min((view == j).nonzero()[:, 0].tolist(), key=lambda other: float(distance[n, other]))
            expected.add((min(n, m), max(n, m)))
    graph = nearest_ray_graph(balls.regions, balls.cameras)
    assert edge_set(graph) == expected
    assert (graph.weights == 1).all()


def test_moved_world_and_other_unit_change_nothing(balls: BallScene) -> None:
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)).double()).Q
    rotation = rotation * torch.linalg.det(rotation)
    away = moved(balls.cameras, 1000.0, rotation, torch.tensor([3e4, -2e4, 5e3]).double())
    assert edge_set(nearest_ray_graph(balls.regions, away)) == edge_set(nearest_ray_graph(balls.regions, balls.cameras))


def test_order_of_regions_and_views_changes_nothing(balls: BallScene) -> None:
    order = torch.randperm(len(balls.regions), generator=torch.Generator().manual_seed(3))
    shuffled = balls.regions.select(order)
    there = {(min(a, b), max(a, b)) for a, b in order[nearest_ray_graph(shuffled, balls.cameras).edges].tolist()}
    assert there == edge_set(nearest_ray_graph(balls.regions, balls.cameras))
    ids = match_points(shuffled, scene_of(balls.cameras)).instance_ids
    assert matching_metrics(ids, balls.regions.labels[order]).ari == 1
    turned = permute_views(balls, [9, 3, 1, 0, 2, 8, 7, 6, 5, 4])
    ids = match_points(turned.regions, scene_of(turned.cameras)).instance_ids
    assert matching_metrics(ids, turned.regions.labels).ari == 1


def test_views_at_one_place_share_no_edge(balls: BallScene) -> None:
    twice = permute_views(balls, [0, 0, 5])
    view = twice.regions.view_index[nearest_ray_graph(twice.regions, twice.cameras).edges]
    assert sorted(set(map(tuple, view.tolist()))) == [(0, 2), (1, 2)]


def test_regions_without_pixels_or_partners_are_unmatched(balls: BallScene) -> None:
    few = regions_from_label_maps([balls.label_maps[0], *(0 * x for x in balls.label_maps[1:])])
    found = match_points(few, scene_of(balls.cameras))
    assert found.instance_ids.tolist() == [-1] * len(few)
    assert found.num_instances == 0
    hollow = replace(balls.regions, crops=balls.regions.crops.clone())
    hollow.crops[: int(hollow.offsets[1])] = False
    assert match_points(hollow, scene_of(balls.cameras)).instance_ids[0] == -1
    none = regions_from_label_maps([0 * x for x in balls.label_maps])
    assert match_points(none, scene_of(balls.cameras)).instance_ids.tolist() == []


def test_wrong_numbers_of_views_are_refused(balls: BallScene) -> None:
    with pytest.raises(InputError, match="regions of 10 views with 9 cameras"):
        match_points(balls.regions, scene_of(balls.cameras[list(range(9))]))
    alone = permute_views(balls, [0])
    with pytest.raises(InputError, match="at least two views"):
        match_points(alone.regions, scene_of(alone.cameras))
