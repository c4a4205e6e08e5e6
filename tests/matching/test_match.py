from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from mvseg.errors import InputError, collect_warnings
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.findings.sentences import DISAGREEMENT
from mvseg.matching.affinity import region_affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions, odd_views
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras, Scene
from synthetic import ball_scene, cameras_at, render_balls
from warned import warns_of


@pytest.mark.parametrize("method", ["auto", "one-per-view", "symnmf"])
def test_shipped_scene_is_solved(
    method: str, demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    matching = match_regions(demo_regions, demo_scene.cameras, MatchConfig(method=method))
    assert matching.report.method == ("nview" if method == "auto" else method)
    metrics = matching_metrics(matching.instance_ids, demo_truth)
    assert (metrics.s_match, metrics.e_k, metrics.ari) == (1.0, 0, 1.0)
    assert matching.num_instances == 12
    assert matching.match_scores.min() > 0.3
    assert matching.match_scores.max() <= 1
    if method == "auto":
        assert matching.support is not None
        assert matching.support.shape == (12,)
        assert matching.support.min() >= 2
        assert matching.report.residual_px == 1
    else:
        assert matching.support is None
        assert matching.report.residual_px is None


def test_the_papers_random_points_solve_it_too(
    demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    matching = match_regions(demo_regions, demo_scene.cameras, MatchConfig(method="symnmf", num_points=200, seed=3))
    assert matching_metrics(matching.instance_ids, demo_truth).ari > 0.95


def test_masks_of_photos_of_half_the_size_are_said(demo_scene: Scene, demo_regions: Regions) -> None:
    sizes = demo_scene.cameras.sizes.tolist()
    maps = [demo_regions.label_map(view, demo_regions.labels, size).numpy() for view, size in enumerate(sizes)]
    with warns_of("masks_of_half_size"):
        match_regions(regions_from_label_maps([each[::2, ::2] for each in maps]), demo_scene.cameras)


def test_scores_are_the_mean_affinity_to_the_cluster() -> None:
    scene = ball_scene(5, 4, seed=2)
    matching = match_regions(scene.regions, scene.cameras, MatchConfig(method="symnmf"))
    W = region_affinity(scene.regions, scene.cameras).to_dense()
    ids, views = matching.instance_ids, scene.regions.view_index
    for n in range(len(scene.regions)):
        partners = [m for m in range(len(ids)) if ids[m] == ids[n] and views[m] != views[n]]
        expected = sum(float(W[n, m]) for m in partners) / max(len(partners), 1)
        assert float(matching.match_scores[n]) == pytest.approx(expected, abs=1e-6)


def test_a_given_number_of_instances_is_for_symnmf() -> None:
    scene = ball_scene(5, 4, seed=2)
    assert match_regions(scene.regions, scene.cameras, MatchConfig(num_instances=4)).report.method == "symnmf"
    assert match_regions(scene.regions, scene.cameras, MatchConfig(search_range=(4, 6))).report.method == "symnmf"
    with pytest.raises(InputError, match="are for symnmf, not for nview"):
        MatchConfig(method="nview", num_instances=4)
    scene = ball_scene(2, 3)
    single_view = dataclasses.replace(scene.regions.select(scene.regions.view_index == 0), num_views=1)
    with pytest.raises(InputError, match="single"):
        match_regions(single_view, scene.cameras[:1])
    with pytest.raises(InputError, match="3 views with 2 cameras"):
        match_regions(scene.regions, scene.cameras[:2])


@pytest.mark.parametrize("method", ["nview", "one-per-view", "symnmf"])
def test_masks_larger_than_the_photos_are_refused(method: str) -> None:
    scene = ball_scene(3, 3)
    maps = [labels.repeat(2, 0).repeat(2, 1) if view == 1 else labels for view, labels in enumerate(scene.label_maps)]
    with pytest.raises(InputError, match=r"region \d of view 1 has the box .* inside the 320 x 240 pixels"):
        match_regions(regions_from_label_maps(maps), scene.cameras, MatchConfig(method=method))


def test_views_that_agree_on_nothing_are_warned_of() -> None:
    scene = ball_scene(6, 4, seed=7, radius=0.1)
    order = [2, 0, 3, 1]  # every photo has the pose of another
    cameras = Cameras(scene.cameras.K, scene.cameras.R[order], scene.cameras.t[order], scene.cameras.sizes)
    with warns_of("views_disagree"):
        assert match_regions(scene.regions, cameras).report.method == "one-per-view"


@pytest.mark.parametrize(("shift", "expected"), [(1, ("views_disagree", 0.55, ())), (2, ("views_odd", None, (7, 8)))])
def test_cameras_of_other_photos_are_warned_of(
    shift: int, expected: tuple[Any, ...], demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    """Of the next, and the next but one: there all but two photos agree with each other."""
    code, share, views = expected
    order = [(view + shift) % 9 for view in range(9)]
    cameras = dataclasses.replace(demo_scene.cameras, R=demo_scene.cameras.R[order], t=demo_scene.cameras.t[order])
    with warns_of(code) as noticed:
        matching = match_regions(demo_regions, cameras)
    (disagreement,) = [each for each in noticed if each.code == code]
    assert disagreement.views == views
    assert share is None or disagreement.values["share"] == pytest.approx(share, abs=0.05)
    assert matching_metrics(matching.instance_ids, demo_truth).ari < 0.7


def test_a_mask_over_the_whole_plant_is_asked_about_and_not_the_cameras(
    demo_scene: Scene, demo_regions: Regions
) -> None:
    sizes = enumerate(demo_scene.cameras.sizes.tolist())
    maps = [demo_regions.label_map(view, demo_regions.labels, size).numpy() for view, size in sizes]
    maps[0] = np.minimum(maps[0], 1)
    regions = regions_from_label_maps(maps)
    with warns_of("view_sparse"):
        match_regions(regions, demo_scene.cameras)


@pytest.mark.parametrize(("px", "is_warned"), [(5, False), (20, True)])
def test_scores_fall_with_the_poses(
    px: float, is_warned: bool, demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    """Cameras turned by noise: five pixels change no id, twenty spoil them."""
    cameras, rng = demo_scene.cameras, np.random.default_rng(0)
    angles = torch.from_numpy(rng.normal(0, px / float(cameras.K[0, 0, 0]), (9, 3)))
    turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3).double()[None], angles[:, None, :], dim=2))
    turned = dataclasses.replace(cameras, R=turn @ cameras.R, t=(turn @ cameras.t[:, :, None])[:, :, 0])
    with collect_warnings() as noticed:
        matching = match_regions(demo_regions, turned)
    assert matching.report.residual_px == 8 or not is_warned
    assert [each.code in DISAGREEMENT for each in noticed] == [True] * is_warned
    ari = matching_metrics(matching.instance_ids, demo_truth).ari
    mean = float(matching.match_scores[matching.instance_ids > 0].mean())
    assert (ari, mean > 0.95) == (1.0, True) if not is_warned else (ari < 0.6 and mean < 0.6)


def test_odd_views_explain_far_less_than_the_median() -> None:
    explained = torch.tensor([0.8, 0.7, float("nan"), 0.48, 0.9])
    assert odd_views(explained) == [3]
    assert odd_views(torch.tensor([0.8, 0.8, 0.1])) == []  # of three, any one may be wrong
    assert odd_views(torch.full((5,), float("nan"))) == []
    assert odd_views(torch.zeros(5)) == []


def test_two_cameras_that_share_a_centre_are_warned_of() -> None:
    cameras = cameras_at(torch.tensor([[10.0, 0, 0], [10.0, 0, 0], [0.0, 10, 0]]))
    centers, radii = torch.tensor([[0.0, 1, 0], [0.0, -1, 1]]).double(), torch.tensor([0.5, 0.5]).double()
    regions = regions_from_label_maps(render_balls(cameras, centers, radii))
    with warns_of("centres_shared"):
        matching = match_regions(regions, cameras)
    assert matching_metrics(matching.instance_ids, regions.labels).ari == 1


@pytest.mark.parametrize("count", [2, 9])
def test_cameras_that_all_share_a_centre_are_refused(count: int) -> None:
    cameras = cameras_at(torch.tensor([[10.0, 0, 0]] * count))
    regions = regions_from_label_maps(render_balls(cameras, torch.zeros(1, 3).double(), torch.tensor([0.5]).double()))
    with pytest.raises(InputError, match=f"all {count} cameras are at one place"):
        match_regions(regions, cameras)


def test_many_pairs_that_share_a_centre_are_one_warning() -> None:
    cameras = cameras_at(torch.tensor([[10.0, 0, 0]] * 6 + [[0.0, 10, 0]]))
    nothing = regions_from_label_maps([np.zeros((240, 320), np.int64)] * 7)
    with warns_of("centres_shared") as noticed:
        match_regions(nothing, cameras)
    (shared,) = [each for each in noticed if each.code == "centres_shared"]
    assert (shared.where, shared.values) == ("views 0 and 1", {"count": 15})


@pytest.mark.parametrize("num_views", [2, 4])
def test_missing_masks_are_not_blamed_on_the_poses(demo_scene: Scene, demo_regions: Regions, num_views: int) -> None:
    few = demo_regions.select(demo_regions.view_index < num_views)
    with warns_of("views_sparse") as noticed:
        match_regions(few, demo_scene.cameras)
    (sparse,) = [each for each in noticed if each.code == "views_sparse"]
    assert (sparse.where, sparse.values["count"], sparse.values["most"]) == ("view 0", 9 - num_views, 12)
