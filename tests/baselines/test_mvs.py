from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.baselines.dense_points import DensePoints
from benchmarks.baselines.mvs import match_mvs, projection_graph, region_points
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.config import MatchConfig
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras, Scene, View
from reference import region_points_reference
from synthetic import BallScene, ball_scene, moved


def scene_of(cameras: Cameras) -> Scene:
    return Scene("balls", tuple(View(str(view), Path(f"{view}.png")) for view in range(len(cameras))), cameras)


def surface_points(balls: BallScene, num_points: int, seed: int = 0) -> torch.Tensor:
    """(K * num_points, 3) random points on the balls."""
    draw = torch.randn(len(balls.radii), num_points, 3, generator=torch.Generator().manual_seed(seed)).double()
    unit = torch.nn.functional.normalize(draw, dim=2)
    return (balls.centers[:, None] + balls.radii[:, None, None] * unit).flatten(0, 1)


@pytest.fixture(scope="module")
def balls() -> BallScene:
    return ball_scene(4, 10, seed=0, radius=0.3)  # hardly one behind another


@pytest.fixture(scope="module")
def points(balls: BallScene) -> torch.Tensor:
    return surface_points(balls, 1500)


def test_good_points_give_the_balls(balls: BallScene, points: torch.Tensor) -> None:
    found = match_mvs(balls.regions, scene_of(balls.cameras), DensePoints(points, "file"))
    assert matching_metrics(found.instance_ids, balls.regions.labels).ari == 1
    assert (found.num_instances, found.report.method) == (4, "mvs (file)")
    config = MatchConfig(num_instances=3)
    fewer = match_mvs(balls.regions, scene_of(balls.cameras), DensePoints(points, "sgbm"), config=config)
    assert (fewer.num_instances, fewer.report.method) == (3, "mvs (sgbm)")


def test_points_of_regions_are_those_of_the_slow_twin(balls: BallScene) -> None:
    few = surface_points(balls, 60, seed=4)
    anchors = region_points(balls.regions, balls.cameras, few)
    expected = region_points_reference(balls.regions, balls.cameras, few)
    torch.testing.assert_close(anchors, expected, equal_nan=True)
    none_in_it = region_points(balls.regions, balls.cameras, balls.centers[:1])
    assert none_in_it.isnan().any()
    torch.testing.assert_close(
        none_in_it, region_points_reference(balls.regions, balls.cameras, balls.centers[:1]), equal_nan=True
    )


def test_nearest_tenth_lies_on_the_near_side(balls: BallScene, points: torch.Tensor) -> None:
    anchors = region_points(balls.regions, balls.cameras, points)
    for index, anchor in enumerate(anchors):
        ball, view = int(balls.regions.labels[index]) - 1, int(balls.regions.view_index[index])
        here = torch.linalg.vector_norm(anchor - balls.cameras.centers[view])
        assert here < torch.linalg.vector_norm(balls.centers[ball] - balls.cameras.centers[view])


def test_edges_lead_to_where_a_regions_point_projects(balls: BallScene, points: torch.Tensor) -> None:
    anchors = region_points(balls.regions, balls.cameras, points)
    pixels, depth = balls.cameras.project(anchors)
    expected = set()
    for n in range(len(anchors)):
        for j, labels in enumerate(balls.label_maps):
            u, v = pixels[j, n].tolist()
            is_inside = depth[j, n] > 0 and 0 <= u < labels.shape[1] and 0 <= v < labels.shape[0]
            if j == int(balls.regions.view_index[n]) or not is_inside or labels[int(v), int(u)] == 0:
                continue
            there = (balls.regions.view_index == j) & (balls.regions.labels == int(labels[int(v), int(u)]))
            expected.add(tuple(sorted((n, int(there.nonzero())))))
    edges = projection_graph(balls.regions, balls.cameras, points).edges
    assert set(map(tuple, edges.tolist())) == expected


def test_moved_world_order_and_repeated_points_change_nothing(balls: BallScene, points: torch.Tensor) -> None:
    plain = projection_graph(balls.regions, balls.cameras, points).edges
    generator = torch.Generator().manual_seed(2)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator).double()).Q
    rotation, shift = rotation * torch.linalg.det(rotation), torch.tensor([3e4, -2e4, 5e3]).double()
    away = moved(balls.cameras, 1000.0, rotation, shift)
    assert torch.equal(projection_graph(balls.regions, away, 1000 * points @ rotation.T + shift).edges, plain)
    order = torch.randperm(len(balls.regions), generator=generator)
    mixed = points[torch.randperm(len(points), generator=generator)]
    shuffled = order[projection_graph(balls.regions.select(order), balls.cameras, mixed).edges]
    assert set(map(tuple, shuffled.sort(1).values.tolist())) == set(map(tuple, plain.tolist()))


def test_points_behind_a_camera_are_in_no_region(balls: BallScene) -> None:
    behind = 2 * balls.cameras.centers[:1] - balls.centers
    assert region_points(balls.regions.select(balls.regions.view_index == 0), balls.cameras, behind).isnan().all()


def test_without_points_there_is_no_matching(balls: BallScene) -> None:
    none = DensePoints(torch.zeros(0, 3), "sgbm")
    with pytest.raises(InputError, match=r"\(sgbm\) found no points in scene 'balls'"):
        match_mvs(balls.regions, scene_of(balls.cameras), none)


def test_points_elsewhere_match_nothing(balls: BallScene, points: torch.Tensor) -> None:
    far = DensePoints(points + 1000, "file")
    assert (match_mvs(balls.regions, scene_of(balls.cameras), far).instance_ids == -1).all()
    empty = regions_from_label_maps([0 * labels for labels in balls.label_maps])
    assert match_mvs(empty, scene_of(balls.cameras), far).num_instances == 0


def test_wrong_numbers_of_views_are_refused(balls: BallScene, points: torch.Tensor) -> None:
    with pytest.raises(InputError, match="regions of 10 views with 9 cameras"):
        match_mvs(balls.regions, scene_of(balls.cameras[list(range(9))]), DensePoints(points, "file"))
