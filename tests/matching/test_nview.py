"""Matching by all views: scores against their definition, laws of the whole, cameras of every kind."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.match import match_regions
from mvseg.matching.numbers import COSTS, EM, NVIEW, SWEEP
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.initialisation import em_affinities
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.nview.plane_sweep import EMPTY, OUTSIDE, PlaneSweep, rays_per_region, sweep_dilated, sweep_planes
from mvseg.matching.nview.search import refine_clusters, search
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.result import Matching
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from reference import soft_affinity_reference
from synthetic import BallScene, arc_positions, ball_scene, cameras_at, moved, permute_views, render_balls


def solve(regions: Regions, cameras: Cameras) -> Matching:
    return match_nview(regions, cameras, ViewGraph.of(region_affinity(regions, cameras), regions))


def same_partition(first: torch.Tensor, second: torch.Tensor) -> bool:
    """Whether equal numbers are at the same places; regions without an instance are one number."""
    return torch.equal(first[:, None] == first, second[:, None] == second)


@pytest.fixture(scope="module")
def balls() -> BallScene:
    return ball_scene(7, 5, seed=4)


@pytest.fixture(scope="module")
def sweep(balls: BallScene) -> PlaneSweep:
    return sweep_planes(balls.regions, balls.cameras)


@pytest.fixture
def scores(balls: BallScene, sweep: PlaneSweep) -> ClusterScores:
    weights = region_affinity(balls.regions, balls.cameras).to_dense().double().numpy()
    return ClusterScores(sweep, ViewGraph(weights, sweep.view_index, sweep.num_views))


def hypothesis_score_reference(sweep: PlaneSweep, row: int, members: set[int]) -> float:
    """Score of one hypothesis in a cluster, from the definition."""
    has_mask = {int(sweep.view_index[m]) for m in members}
    total, inside = 0.0, 0
    for view, label in enumerate(sweep.labels[row].tolist()):
        if label == OUTSIDE:
            continue
        inside += 1
        if label == EMPTY:
            total -= COSTS.missing if view in has_mask else COSTS.absent
        else:
            total += 1 if label in members else -COSTS.hidden
    return total / inside


def score_reference(sweep: PlaneSweep, region: int, members: set[int]) -> float:
    """S(n, c) from the definition."""
    scores = []
    for pixel in np.flatnonzero(sweep.pixel_region == region):
        rows = np.flatnonzero(sweep.pixel == pixel)
        scores.append(max([-COSTS.hidden] + [hypothesis_score_reference(sweep, int(row), members) for row in rows]))
    return float(np.mean(scores))


def some_clusters(sweep: PlaneSweep, seed: int) -> Clusters:
    return Clusters.of(np.random.default_rng(seed).integers(0, 6, len(sweep.view_index)))


def test_scores_agree_with_the_definition(sweep: PlaneSweep, scores: ClusterScores) -> None:
    clusters = some_clusters(sweep, 0)
    for view in (0, 3):
        view_scores = scores.scores(view, clusters.ids)
        for row, region in enumerate(np.flatnonzero(sweep.view_index == view).tolist()):
            for cluster in range(len(clusters)):
                members = set(np.flatnonzero((clusters.ids == cluster) & (sweep.view_index != view)).tolist())
                assert view_scores[row, cluster] == pytest.approx(score_reference(sweep, region, members), abs=1e-5)
    clusters = some_clusters(sweep, 1)
    own_scores, ids = scores.own(clusters), clusters.ids
    for region in range(0, len(ids), 3):
        members = {m for m in np.flatnonzero(ids == ids[region]).tolist() if m != region}
        assert own_scores[region] == pytest.approx(score_reference(sweep, region, members | {region}), abs=1e-5)


def test_coverage_agrees_with_the_definition(sweep: PlaneSweep, scores: ClusterScores) -> None:
    clusters = some_clusters(sweep, 2)
    cluster_coverages, ids = scores.coverages(clusters), clusters.ids
    view, cluster = 2, int(ids[0])
    hits, pixels = np.zeros(len(ids)), 0
    members = set(np.flatnonzero(ids == cluster).tolist())
    labels = np.where(np.arange(sweep.num_views) == view, OUTSIDE, sweep.labels)
    masked_sweep = dataclasses.replace(sweep, labels=labels)
    for pixel, region in enumerate(sweep.pixel_region.tolist()):
        rows = np.flatnonzero(sweep.pixel == pixel)
        if region not in members or sweep.view_index[region] == view or not len(rows):
            continue
        values = []
        for row in rows.tolist():
            is_alone = (masked_sweep.labels[row] == OUTSIDE).all()
            values.append(0.0 if is_alone else hypothesis_score_reference(masked_sweep, row, members))
        best = [row for row, value in zip(rows.tolist(), values, strict=True) if value >= max(values) - 1e-6]
        if max(values) >= 0:
            pixels += 1
            for row in best:
                if sweep.labels[row, view] >= 0:
                    hits[sweep.labels[row, view]] += 1 / len(best)
    np.testing.assert_allclose(
        cluster_coverages[cluster, sweep.view_index == view], (hits / pixels)[sweep.view_index == view], atol=1e-5
    )


def test_cached_scores_are_what_computing_again_gives(sweep: PlaneSweep, scores: ClusterScores) -> None:
    """Scores are cached by members; between the steps, some regions change their cluster."""
    clusters = some_clusters(sweep, 3)
    for step in range(3):
        ids = clusters.ids
        clusters = Clusters.of(np.where(np.arange(len(ids)) % 7 == step, np.roll(ids, 1), ids))
        fresh = ClusterScores(sweep, scores.graph)
        np.testing.assert_allclose(scores.coverages(clusters), fresh.coverages(clusters), atol=1e-6)
        for _ in range(2):
            np.testing.assert_array_equal(scores.own(clusters), fresh.own(clusters))
            assert scores.value(clusters) == fresh.value(clusters)
        for view in range(sweep.num_views):
            np.testing.assert_allclose(scores.scores(view, clusters.ids), fresh.scores(view, clusters.ids), atol=1e-6)


def test_regions_of_the_view_itself_do_not_matter(sweep: PlaneSweep, scores: ClusterScores) -> None:
    clusters = some_clusters(sweep, 4).ids
    reassigned = np.where(sweep.view_index == 1, 0, clusters)
    np.testing.assert_array_equal(scores.scores(1, clusters), scores.scores(1, reassigned))
    left_out = np.where(clusters == 0, -1, clusters)
    np.testing.assert_array_equal(scores.scores(1, clusters)[:, 1:], scores.scores(1, left_out)[:, 1:])
    assert scores.scores(1, np.full(len(clusters), -1)).shape == (int((sweep.view_index == 1).sum()), 0)


def test_hypotheses_are_what_points_on_the_ray_show(balls: BallScene, sweep: PlaneSweep) -> None:
    """Every hypothesis is shown, label by label, where some depth on its ray projects into the label maps, or next to
    it."""
    rng, cameras = np.random.default_rng(0), balls.cameras
    xy, region = balls.regions.spread_pixels(rays_per_region(len(cameras)))
    assert torch.equal(region, torch.from_numpy(sweep.pixel_region))
    for row in rng.choice(len(sweep.labels), 60, replace=False).tolist():
        pixel, labels = int(sweep.pixel[row]), sweep.labels[row].tolist()
        view = int(sweep.view_index[region[pixel]])
        ray = cameras.world_from_px[view] @ torch.tensor([*xy[pixel].tolist(), 1.0]).double()
        points = cameras.centers[view] + ray / torch.linspace(0.001, 0.5, 20_000)[:, None]
        places, depths = cameras.project(points)
        assert labels[view] == OUTSIDE
        is_shown = np.ones(len(points), bool)
        for other, label in enumerate(labels):
            if other == view or label == OUTSIDE:
                continue
            number = 0 if label < 0 else int(balls.regions.labels[label])
            near = cv2.dilate((balls.label_maps[other] == number).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            u, v = places[other].floor().long().numpy().T
            inside = (u >= 0) & (v >= 0) & (u < near.shape[1]) & (v < near.shape[0]) & (depths[other] > 0).numpy()
            is_shown &= inside & near[np.where(inside, v, 0), np.where(inside, u, 0)]
        assert is_shown.any()


def test_scores_do_not_depend_on_how_many_rows_are_worked_on_at_a_time(
    scores: ClusterScores, monkeypatch: pytest.MonkeyPatch
) -> None:
    clusters = some_clusters(scores.sweep, 5)
    expected = scores.own(clusters), scores.coverages(clusters), em_affinities(scores.sweep)[-1]
    monkeypatch.setattr("mvseg.matching.nview.plane_sweep.SWEEP", replace(SWEEP, block_size=50))
    monkeypatch.setattr("mvseg.matching.nview.initialisation.SWEEP", replace(SWEEP, block_size=7))
    again = ClusterScores(scores.sweep, scores.graph)
    found = again.own(clusters), again.coverages(clusters), em_affinities(scores.sweep)[-1]
    for each, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(each, wanted, atol=1e-5)


def test_label_maps_that_grow_step_by_step_give_the_sweep_of_each_step(balls: BallScene) -> None:
    dilations = (1, 2, 5)
    sweeps = sweep_dilated(balls.regions, balls.cameras, dilations=dilations)
    for dilation_px, grown in zip(dilations, sweeps, strict=True):
        expected = sweep_planes(balls.regions, balls.cameras, dilation_px=dilation_px)
        np.testing.assert_array_equal(grown.labels, expected.labels)
        np.testing.assert_array_equal(grown.pixel, expected.pixel)


def test_balls_are_solved_and_scored(balls: BallScene) -> None:
    matching = solve(balls.regions, balls.cameras)
    assert same_partition(matching.instance_ids, balls.regions.labels)
    assert matching.report.method == "nview"
    assert matching.report.residual_px == 1
    assert matching.report.explained is not None
    assert matching.report.explained > 0.7
    assert matching.match_scores.median() > 0.9
    sure = matching.match_scores >= 0.5
    seen = [len(set(balls.regions.view_index[sure & (matching.instance_ids == k)].tolist())) for k in range(1, 8)]
    assert matching.support.tolist() == seen


def test_same_answer_twice_and_in_any_order_of_views_and_regions() -> None:
    scene = ball_scene(16, 4, seed=11, spread=1.2)
    first, second = solve(scene.regions, scene.cameras), solve(scene.regions, scene.cameras)
    assert torch.equal(first.instance_ids, second.instance_ids)
    assert torch.equal(first.match_scores, second.match_scores)
    order = torch.randperm(len(scene.regions), generator=torch.Generator().manual_seed(1))
    shuffled = solve(scene.regions.select(order), scene.cameras)
    assert same_partition(shuffled.instance_ids, first.instance_ids[order])
    torch.testing.assert_close(shuffled.match_scores, first.match_scores[order], atol=1e-4, rtol=0)
    views = [2, 0, 3, 1]
    turned = permute_views(scene, views)
    region_of = {(v, n): i for i, (v, n) in enumerate(zip(*labels_of(scene.regions), strict=True))}
    index = [region_of[views[v], n] for v, n in zip(*labels_of(turned.regions), strict=True)]
    matching = solve(turned.regions, turned.cameras)
    assert same_partition(matching.instance_ids, first.instance_ids[index])


def labels_of(regions: Regions) -> tuple[list[int], list[int]]:
    return regions.view_index.tolist(), regions.labels.tolist()


def test_the_world_may_be_moved_turned_and_scaled_and_photos_be_larger() -> None:
    scene = ball_scene(10, 4, seed=5)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)).double())[0]
    rotation = rotation * torch.linalg.det(rotation).sign()
    expected = solve(scene.regions, scene.cameras)
    matching = solve(scene.regions, moved(scene.cameras, 250.0, rotation, torch.tensor([9.0, -4.0, 70.0]).double()))
    assert same_partition(matching.instance_ids, expected.instance_ids)
    torch.testing.assert_close(matching.match_scores, expected.match_scores, atol=0.02, rtol=0)
    scene = ball_scene(10, 5, seed=6)
    big = ball_scene(10, 5, seed=6, focal=800.0, width=640, height=480)
    matching, expected = solve(big.regions, big.cameras), solve(scene.regions, scene.cameras)
    assert same_partition(matching.instance_ids, big.regions.labels)
    assert same_partition(expected.instance_ids, scene.regions.labels)


def test_missed_masks_leave_the_rest_together(balls: BallScene) -> None:
    keep = torch.ones(len(balls.regions), dtype=torch.bool)
    keep[3::7] = False
    regions = balls.regions.select(keep)
    assert same_partition(solve(regions, balls.cameras).instance_ids, regions.labels)


def test_pieces_of_a_split_mask_are_joined() -> None:
    scene = ball_scene(5, 6, seed=2)
    labels = scene.label_maps[2].copy()
    rows, columns = np.nonzero(labels == labels[labels > 0].min())
    whole = int(labels[rows[0], columns[0]])
    labels[rows[columns > columns.mean()], columns[columns > columns.mean()]] = 90
    regions = regions_from_label_maps([*scene.label_maps[:2], labels, *scene.label_maps[3:]])
    truth = torch.where(regions.labels == 90, whole, regions.labels)
    assert same_partition(solve(regions, scene.cameras).instance_ids, truth)


def test_pieces_do_not_form_a_spurious_instance() -> None:
    """One ball is cut in two in two of ten views: too few for the parts on one side to be an instance of their own."""
    scene = ball_scene(6, 10, seed=2)
    maps = [labels.copy() for labels in scene.label_maps]
    for view in (1, 5):
        rows, columns = np.nonzero(maps[view] == 2)
        maps[view][rows[columns > columns.mean()], columns[columns > columns.mean()]] = 90
    regions = regions_from_label_maps(maps)
    assert int((regions.labels == 90).sum()) == 2
    truth = torch.where(regions.labels == 90, 2, regions.labels)
    matching = solve(regions, scene.cameras)
    assert same_partition(matching.instance_ids, truth)
    assert matching.num_instances == 6


def test_a_region_that_nobody_else_sees_is_unmatched(balls: BallScene) -> None:
    labels = balls.label_maps[0].copy()
    free = np.argwhere(labels[:20, :20] == 0)
    labels[free[:, 0], free[:, 1]] = 77
    regions = regions_from_label_maps([labels, *balls.label_maps[1:]])
    matching = solve(regions, balls.cameras)
    alone = regions.labels == 77
    assert matching.instance_ids[alone].tolist() == [-1]
    assert matching.match_scores[alone].tolist() == [0]
    assert same_partition(matching.instance_ids[~alone], regions.labels[~alone])


def test_refinement_never_ends_below_the_truth_on_clear_scenes(balls: BallScene, scores: ClusterScores) -> None:
    truth = Clusters.of(balls.regions.labels.numpy())
    np.testing.assert_array_equal(refine_clusters(scores, truth).ids, truth.ids)
    partition = search(scores, Clusters.of(np.arange(len(truth.ids))))
    np.testing.assert_array_equal(search(scores, truth).ids, truth.ids)
    assert scores.value(partition) >= scores.value(truth) - 1e-6


@pytest.mark.parametrize("views", [EM.views, 4])
def test_soft_affinity_is_symmetric_and_favours_the_truth(
    views: int, balls: BallScene, sweep: PlaneSweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvseg.matching.nview.initialisation.EM", replace(EM, views=views))
    A = em_affinities(sweep)[-1]
    np.testing.assert_allclose(A, A.T)
    same = (balls.regions.labels[:, None] == balls.regions.labels).numpy()
    across = sweep.view_index[:, None] != sweep.view_index
    assert A.min() >= 0
    assert A.max() <= 1 + 1e-6
    assert A[same & across].mean() > 0.6 > 0.1 > A[~same & across].mean()
    assert (A[~across] == 0).all()


def test_soft_affinity_agrees_with_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = ball_scene(3, 4, seed=2)
    monkeypatch.setattr("mvseg.matching.nview.plane_sweep.SWEEP", replace(SWEEP, rays=4))
    sweep = sweep_planes(scene.regions, scene.cameras)
    lists = (each.tolist() for each in (sweep.labels, sweep.pixel, sweep.pixel_region))
    expected = soft_affinity_reference(*lists, num_regions=len(sweep.view_index), sharpness=[8.0, 12.0])
    np.testing.assert_allclose(em_affinities(sweep)[1], expected, atol=2e-4)


def test_instances_that_leave_the_image() -> None:
    scene = ball_scene(8, 6, seed=9, focal=900.0)
    assert int((scene.regions.boxes[:, 0] == 0).sum()) > 3
    assert matching_metrics(solve(scene.regions, scene.cameras).instance_ids, scene.regions.labels).ari > 0.95


TURN = torch.arange(8) / 8 * 2 * torch.pi
RING = torch.stack((10 * TURN.cos(), 10 * TURN.sin(), 3 + TURN.sin()), 1)
LINE = torch.stack((torch.linspace(-3, 3, 6), torch.full((6,), -10.0), torch.zeros(6)), 1)
FACING = torch.tensor([[0.0, -8, 0.2], [0.3, -14, 0], [0, 9, 0.5], [8, 0.5, 1]])  # epipoles lie inside the images


@pytest.mark.parametrize(
    ("cameras", "options", "least"),
    [
        (cameras_at(RING), {"num_balls": 8, "seed": 8}, 1),
        (cameras_at(LINE), {"num_balls": 6, "seed": 10, "radius": 0.3}, 0.9),
        (cameras_at(FACING, focal=250.0), {"num_balls": 6, "seed": 12}, 0.9),
    ],
    ids=["ring", "line", "facing"],
)
def test_cameras_of_every_kind(cameras: Cameras, options: dict, least: float) -> None:
    scene = ball_scene(num_views=3, **options)
    regions = regions_from_label_maps(render_balls(cameras, scene.centers, scene.radii))
    assert matching_metrics(solve(regions, cameras).instance_ids, regions.labels).ari >= least


def test_two_views_fall_back_on_the_pairs() -> None:
    scene = ball_scene(3, 2, seed=1)
    matching = solve(scene.regions, scene.cameras)
    assert matching.report.method == "one-per-view"
    assert same_partition(matching.instance_ids, scene.regions.labels)


def test_nothing_to_match() -> None:
    cameras = cameras_at(arc_positions(3))
    matching = solve(regions_from_label_maps([np.zeros((240, 320), int)] * 3), cameras)
    assert matching.instance_ids.shape == matching.match_scores.shape == (0,)
    assert matching.support is not None
    assert matching.support.shape == (0,)
    labels = render_balls(cameras[[0]], torch.zeros(1, 3), torch.ones(1))[0]
    matching = solve(regions_from_label_maps([labels, np.zeros_like(labels), np.zeros_like(labels)]), cameras)
    assert matching.instance_ids.tolist() == [-1]


def test_pose_errors_are_noticed_measured_and_tolerated() -> None:
    scene = ball_scene(6, 6, seed=7, radius=0.25)
    matching = solve(scene.regions, turned_a_little(scene.cameras, 0.004))
    assert same_partition(matching.instance_ids, scene.regions.labels)
    assert matching.report.explained < solve(scene.regions, scene.cameras).report.explained
    scene = ball_scene(6, 6, seed=7, radius=0.1)
    matching = solve(scene.regions, turned_a_little(scene.cameras, 0.008))
    assert matching.report.residual_px > 1
    assert matching.report.method == "nview"
    assert same_partition(matching.instance_ids, scene.regions.labels)


def test_the_reprojection_error_may_be_known_from_an_earlier_matching(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = ball_scene(6, 6, seed=7, radius=0.1)
    cameras = turned_a_little(scene.cameras, 0.008)
    first = solve(scene.regions, cameras)
    graph = ViewGraph.of(region_affinity(scene.regions, cameras), scene.regions)
    monkeypatch.setattr("mvseg.matching.nview.match_nview.sweep_dilated", None)  # nothing is tried
    again = match_nview(scene.regions, cameras, graph, residual_px=first.report.residual_px)
    assert torch.equal(again.instance_ids, first.instance_ids)
    assert again.report.residual_px == first.report.residual_px
    with pytest.raises(InputError, match="residual_px is 3, expected one of 1, 2, 4, 8"):
        match_regions(scene.regions, cameras, residual_px=3)


@pytest.mark.parametrize("angle", [0.004, 0.02])
def test_a_few_rays_tell_the_reprojection_error(angle: float, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = ball_scene(6, 6, seed=7, radius=0.1)
    cameras = turned_a_little(scene.cameras, angle)
    monkeypatch.setattr("mvseg.matching.nview.match_nview.NVIEW", replace(NVIEW, probe_rays=10**9))
    everything = solve(scene.regions, cameras)
    monkeypatch.setattr("mvseg.matching.nview.match_nview.NVIEW", replace(NVIEW, probe_rays=5 * len(scene.regions)))
    few = solve(scene.regions, cameras)
    assert few.report.residual_px == everything.report.residual_px
    assert torch.equal(few.instance_ids, everything.instance_ids)


def test_where_the_views_agree_on_nothing_the_pairs_answer() -> None:
    scene = ball_scene(6, 4, seed=7, radius=0.1)
    cameras = turned_a_little(scene.cameras, 0.3)
    matching = solve(scene.regions, cameras)
    assert matching.report.method == "one-per-view"
    assert matching.report.explained < 0.3
    graph = ViewGraph.of(region_affinity(scene.regions, cameras), scene.regions)
    pairwise = one_per_view_clusters(graph).drop_singletons()
    assert same_partition(matching.instance_ids, pairwise.instance_ids())


def test_regions_without_a_pixel_and_very_many_views(balls: BallScene, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = balls.regions.crop(0).clone().flatten().fill_(False)
    size = len(empty)
    regions = dataclasses.replace(balls.regions, crops=torch.cat((empty, balls.regions.crops[size:])))
    matching = solve(regions, balls.cameras)
    assert matching.instance_ids[0] == -1
    assert same_partition(matching.instance_ids[1:], regions.labels[1:])
    # as with 500 times as many views: still one pixel per region
    monkeypatch.setattr("mvseg.matching.nview.plane_sweep.SWEEP", replace(SWEEP, plenty=0.01))
    sweep = sweep_planes(balls.regions, balls.cameras)
    assert np.bincount(sweep.pixel_region).tolist() == [1] * len(balls.regions)
    assert np.isfinite(em_affinities(sweep)[-1]).all()


def turned_a_little(cameras: Cameras, radians: float) -> Cameras:
    """Cameras whose orientation is off by about `radians`."""
    noise = radians * torch.randn(len(cameras), 3, generator=torch.Generator().manual_seed(3)).double()
    turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3).double()[None], noise[:, None], dim=2))
    return Cameras(cameras.K, turn @ cameras.R, (turn @ cameras.t[:, :, None])[:, :, 0], cameras.sizes)
