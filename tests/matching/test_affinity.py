"""Eq. 3 by angles, against Eq. 3 by drawn lines."""

from __future__ import annotations

import pytest
import torch

from mvseg.matching.affinity import pairwise_affinity, region_affinity
from mvseg.matching.epipolar import Bins
from mvseg.matching.samples import view_samples
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Scene
from reference import affinity_reference
from synthetic import arc_positions, ball_scene, cameras_at, moved, render_balls


def symmetric(directed: torch.Tensor) -> torch.Tensor:
    return (directed + directed.T) / 2


@pytest.fixture(scope="module")
def two_views(demo_scene: Scene, demo_regions: Regions) -> tuple[Regions, Scene]:
    """Views 1 and 4 of the shipped scene: what the drawn twin can do in seconds."""
    keep = (demo_regions.view_index == 1) | (demo_regions.view_index == 4)
    chosen = demo_regions.select(keep)
    renumbered = (chosen.view_index == 4).long()
    cameras = demo_scene.cameras[[1, 4]]
    views = (demo_scene.views[1], demo_scene.views[4])
    regions = Regions(renumbered, chosen.boxes, chosen.crops, 2, chosen.labels)
    return regions, Scene("two", views, cameras)


@pytest.mark.slow
def test_agrees_with_drawn_lines_better_than_two_samplings_do(two_views: tuple[Regions, Scene]) -> None:
    regions, scene = two_views
    drawn = torch.stack([symmetric(affinity_reference(regions, scene.cameras, 200, seed)) for seed in range(3)])
    pairs = regions.view_index[:, None] != regions.view_index
    ours = region_affinity(regions, scene.cameras).to_dense()
    difference = (ours - drawn.mean(0))[pairs].abs()
    assert difference.mean() <= 0.01
    assert difference.max() <= 0.12
    samplings = torch.stack([(drawn[a] - drawn[b])[pairs].abs().mean() for a in range(3) for b in range(a)])
    assert difference.mean() < samplings.mean()


def test_runs_of_pixels_give_the_weights_of_pixels(
    demo_scene: Scene, demo_regions: Regions, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = region_affinity(demo_regions, demo_scene.cameras).to_dense()
    monkeypatch.setattr("mvseg.matching.affinity.view_runs", view_samples)
    difference = (ours - region_affinity(demo_regions, demo_scene.cameras).to_dense()).abs()
    assert difference.max() < 0.05
    assert difference[ours > 0].mean() < 0.003


def test_random_points_agree_with_all_points(two_views: tuple[Regions, Scene]) -> None:
    regions, scene = two_views
    everything = region_affinity(regions, scene.cameras).to_dense()
    first = region_affinity(regions, scene.cameras, num_points=200, seed=1).to_dense()
    again = region_affinity(regions, scene.cameras, num_points=200, seed=1).to_dense()
    other = region_affinity(regions, scene.cameras, num_points=200, seed=2).to_dense()
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first - everything).abs().mean() < 0.01


def test_dense_form_is_symmetric_with_edges_between_views_only() -> None:
    scene = ball_scene(8, 4)
    affinity = region_affinity(scene.regions, scene.cameras)
    W = affinity.to_dense()
    assert torch.equal(W, W.T)
    same_view = scene.regions.view_index[:, None] == scene.regions.view_index
    assert W[same_view].max() == 0
    assert 0 < W.max() <= 1
    assert (affinity.edges[:, 0] < affinity.edges[:, 1]).all()
    assert len(affinity.edges.unique(dim=0)) == len(affinity.edges)


def test_the_world_may_be_moved_turned_and_scaled() -> None:
    scene = ball_scene(7, 4, seed=6)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)).double())[0]
    rotation = rotation * torch.linalg.det(rotation)
    other = moved(scene.cameras, 0.01, rotation, torch.tensor([5.0, -2.0, 40.0]).double())
    W = region_affinity(scene.regions, scene.cameras).to_dense()
    torch.testing.assert_close(region_affinity(scene.regions, other).to_dense(), W, atol=0.02, rtol=0)


def test_a_coarse_sender_leaves_no_gaps_in_a_fine_image() -> None:
    """A camera of a quarter of the resolution: its neighbouring pixels are four fine pixels apart."""
    positions = arc_positions(2)
    centers, radii = torch.tensor([[0.0, 0, 0]]).double(), torch.tensor([0.8]).double()
    fine = cameras_at(positions[:1], focal=1600.0, width=1280, height=960)
    coarse = cameras_at(positions[1:], focal=200.0, width=160, height=120)
    cameras = type(fine)(*(torch.cat((getattr(fine, f), getattr(coarse, f))) for f in ("K", "R", "t", "sizes")))
    regions = regions_from_label_maps(render_balls(cameras, centers, radii))
    assert region_affinity(regions, cameras).weights.item() > 0.95


def test_sums_of_shares_of_pixels_never_exceed_1(demo_scene: Scene, demo_regions: Regions) -> None:
    """Regions whose bands hold all of each other: rounded sums in two orders, a quotient of 1 or a little more."""
    weights = region_affinity(demo_regions, demo_scene.cameras).weights
    assert 0.999 < weights.max() <= 1
    bins = Bins(low=0.0, per_unit=1.0, num_bins=999, half_line=(1, 1), half_pixel=(1, 1))
    pixels = tuple(torch.rand(50, 999, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    lines = tuple(each.clone() for each in pixels)
    for w in pairwise_affinity(bins, (pixels[0], pixels[1]), (lines[0], lines[1])):
        assert w.max() <= 1
        assert w.min() > 0.999
