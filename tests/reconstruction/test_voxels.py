"""Eq. 6 against points projected one by one, and against solids of known volume."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.numbers import VOXELS
from mvseg.reconstruction.voxels import VoxelGrid, back_project, reconstruct_instances
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from reference import back_project_reference, seen_share_reference
from synthetic import arc_positions, ball_scene, cameras_at, moved, render_balls
from warned import warns_of

FAR = 1000.0  # cameras so far away that they see in parallel


def ball_from(directions: list[list[float]], *, focal: float = 80_000.0) -> tuple[Regions, Cameras]:
    """A ball of radius 1 at the origin, seen in parallel along the given directions."""
    cameras = cameras_at(FAR * torch.tensor(directions), focal=focal, width=320, height=320)
    maps = render_balls(cameras, torch.zeros(1, 3).double(), torch.ones(1).double())
    return regions_from_label_maps(maps), cameras


AXES = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]


@pytest.mark.parametrize(
    ("num_views", "volume"),
    [(2, 16 / 3), (3, 8 * (2 - math.sqrt(2)))],  # Steinmetz's solids: what two and three cylinders have in common
)
def test_volume_of_what_cylinders_have_in_common(num_views: int, volume: float) -> None:
    regions, cameras = ball_from(AXES[:num_views])
    errors = []
    for size in (0.2, 0.1, 0.05, 0.025):
        grid = back_project(regions, cameras, config=ReconstructConfig(threshold=0.9, voxel_size=size))
        assert grid is not None
        errors.append(abs(grid.volume - volume) / volume)
    assert errors[-1] < 0.01
    assert errors[-1] < errors[0]
    fine = back_project(regions, cameras, config=ReconstructConfig(threshold=0.9, voxel_size=0.05))
    assert fine is not None
    mesh = fine.mesh()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=0.03)
    np.testing.assert_allclose(mesh.bounds, [[-1, -1, -1], [1, 1, 1]], atol=0.06)


def test_votes_agree_with_points_projected_one_by_one() -> None:
    scene = ball_scene(3, 5, seed=2, focal=200.0, width=160, height=120)
    members = scene.regions.select(scene.regions.labels == 2)
    grid = back_project(members, scene.cameras, config=ReconstructConfig(voxel_budget=2000))
    assert grid is not None
    index = torch.cartesian_prod(*(torch.arange(side) for side in grid.votes.shape))
    centers = grid.origin + grid.voxel_size * (index + 0.5)
    expected = back_project_reference(members, scene.cameras, centers).reshape(grid.votes.shape)
    assert ((grid.votes - expected).abs() > 1e-6).float().mean() < 0.002  # points on the edge of a pixel, in float32
    assert torch.equal(grid.occupied, grid.votes > 0.5 + 1e-6)
    torch.testing.assert_close(grid.points, centers[grid.occupied.flatten()])


def test_seen_share_agrees_with_points_projected_one_by_one() -> None:
    """It removes voxels, but none where another instance may hide the point, and leaves all other votes unchanged."""
    scene = ball_scene(4, 6, seed=2, focal=200.0, width=160, height=120)
    ids = scene.regions.labels
    configs = (ReconstructConfig(voxel_size=0.16, seen_share=share) for share in (0, 0.8))
    plain, seen = (reconstruct_instances(scene.regions, ids, scene.cameras, config=each) for each in configs)
    removed = 0
    for instance, grid in seen.items():
        index = torch.cartesian_prod(*(torch.arange(side) for side in grid.votes.shape))
        centers = grid.origin + grid.voxel_size * (index + 0.5)
        share = seen_share_reference(scene.regions.select(ids == instance), scene.regions, scene.cameras, centers)
        votes = plain[instance].votes.flatten()
        expected = votes.where(share > 0.8 + 1e-6, 0)
        assert ((grid.votes.flatten() - expected).abs() > 1e-6).float().mean() < 0.002
        removed += int(plain[instance].occupied.sum() - grid.occupied.sum())
        assert grid.mesh().is_watertight
    assert removed > 40


def test_what_stands_behind_something_is_not_carved_away() -> None:
    """Two of six views see half of a ball: requiring all masks loses much of it, seen_share does not."""
    cameras = cameras_at(arc_positions(6, distance=40.0), focal=800.0)
    maps = render_balls(cameras, torch.zeros(1, 3).double(), torch.ones(1).double())
    for labels in maps[:2]:
        columns = np.nonzero(labels)[1]
        labels[:, : int(columns.mean())] = 2  # a wall in front of the left half
    regions = regions_from_label_maps(maps)
    ids = torch.where(regions.labels == 1, 1, -1)
    ball = 4 / 3 * math.pi
    volumes = {}
    for name, config in {
        "paper": ReconstructConfig(voxel_size=0.08, seen_share=0),
        "all masks": ReconstructConfig(voxel_size=0.08, seen_share=0, threshold=0.9),
        "seen": ReconstructConfig(voxel_size=0.08, seen_share=0.9),
    }.items():
        volumes[name] = reconstruct_instances(regions, ids, cameras, config=config)[1].volume / ball
    assert volumes["all masks"] < 0.8
    assert 0.98 < volumes["seen"] < volumes["paper"]


def test_without_free_pixels_the_paper_rule_is_left() -> None:
    regions, cameras = ball_from(AXES)
    sizes = enumerate(cameras.sizes.tolist())
    nowhere = {view: torch.zeros(height, width, dtype=torch.bool) for view, (width, height) in sizes}
    paper = back_project(regions, cameras, config=ReconstructConfig(voxel_size=0.1, seen_share=0))
    assert paper is not None
    for free in (None, nowhere):
        grid = back_project(regions, cameras, config=ReconstructConfig(voxel_size=0.1, seen_share=0.9), free=free)
        assert grid is not None
        assert torch.equal(grid.votes, paper.votes)


def test_the_box_holds_all_that_exceeds_the_threshold() -> None:
    """The box against random points in ten times its volume."""
    scene = ball_scene(2, 6, seed=1, focal=200.0, width=160, height=120)
    members = scene.regions.select(scene.regions.labels == 1)
    grid = back_project(members, scene.cameras, config=ReconstructConfig(voxel_budget=3000))
    assert grid is not None
    generator = torch.Generator().manual_seed(0)
    low, high = grid.origin, grid.origin + grid.voxel_size * torch.tensor(grid.votes.shape)
    wide = (low + high) / 2 + (torch.rand(3_000, 3, generator=generator).double() - 0.5) * 2.2 * (high - low)
    votes = back_project_reference(members, scene.cameras, wide)
    inside = ((wide >= low) & (wide <= high)).all(1)
    assert (votes[inside] > 0.5).any()
    assert not (votes[~inside] > 0.5).any()


def test_thin_leaves_are_not_lost_by_the_search() -> None:
    """A blade of 0.02 thickness beside a box of 2: a tenth of a search cell."""
    _, cameras = ball_from(AXES[:2])
    maps = [np.zeros((320, 320), np.int64) for _ in range(2)]
    maps[0][159:161, 80:240] = 1
    maps[1][159:161, 80:240] = 1
    grid = back_project(regions_from_label_maps(maps), cameras, config=ReconstructConfig(voxel_size=0.0125))
    assert grid is not None
    assert grid.volume == pytest.approx(2 * 2 * 0.025, rel=0.15)


def test_a_moved_and_scaled_world_moves_and_scales_the_shape() -> None:
    scene = ball_scene(2, 5, seed=3)
    members = scene.regions.select(scene.regions.labels == 1)
    shift = torch.tensor([1000.0, -2000.0, 300.0]).double()
    other = moved(scene.cameras, 25.0, torch.eye(3).double(), shift)
    grids = [back_project(members, cameras) for cameras in (scene.cameras, other)]
    assert grids[0] is not None
    assert grids[1] is not None
    assert grids[1].volume == pytest.approx(25.0**3 * grids[0].volume, rel=0.03)
    middle = [grid.points.mean(0) for grid in grids if grid is not None]
    torch.testing.assert_close(middle[1], 25 * middle[0] + shift, atol=0.5, rtol=0)


def test_grids_of_one_voxel_size_share_their_lattice() -> None:
    scene = ball_scene(3, 5, seed=4)
    config = ReconstructConfig(voxel_size=0.07)
    shapes = reconstruct_instances(scene.regions, scene.regions.labels, scene.cameras, config=config)
    assert sorted(shapes) == [1, 2, 3]
    for grid in shapes.values():
        steps = grid.origin / 0.07
        torch.testing.assert_close(steps, steps.round(), atol=1e-6, rtol=0)


def test_pieces_of_a_split_mask_vote_as_one() -> None:
    regions, cameras = ball_from(AXES)
    maps = [regions.label_map(view, regions.labels, (320, 320)).numpy() for view in range(3)]
    maps[0][:, 160:] *= 2
    pieces = regions_from_label_maps(maps)
    assert len(pieces) == 4
    whole, joined = (back_project(r, cameras, config=ReconstructConfig(voxel_size=0.1)) for r in (regions, pieces))
    assert whole is not None
    assert joined is not None
    assert torch.equal(whole.votes, joined.votes)


def test_what_has_no_bounded_shape_is_left_out() -> None:
    regions, cameras = ball_from(AXES)
    assert back_project(regions.select(torch.tensor([1])), cameras) is None
    assert reconstruct_instances(regions, torch.tensor([1, -1, -1]), cameras) == {}
    maps = [np.zeros((320, 320), np.int64) for _ in range(2)]
    maps[0][0:20, 0:20] = 1  # two masks that look past each other
    maps[1][300:320, 0:20] = 1
    apart = regions_from_label_maps(maps)
    with warns_of("no_shape"):
        assert reconstruct_instances(apart, torch.tensor([1, 1]), cameras[:2]) == {}


def test_nearly_parallel_views_are_cut_not_lost() -> None:
    cameras = cameras_at(torch.tensor([[10.0, 0, 0], [10.0, 0.01, 0]]))
    maps = render_balls(cameras, torch.zeros(1, 3).double(), torch.ones(1).double())
    with warns_of("shape_cut_off"):
        grid = back_project(regions_from_label_maps(maps), cameras, config=ReconstructConfig(voxel_budget=20_000))
    assert grid is not None
    assert 0 < grid.volume < 1e5


def test_an_empty_grid_has_an_empty_mesh_and_its_instance_is_left_out() -> None:
    regions, cameras = ball_from(AXES)
    coarse = ReconstructConfig(voxel_size=8.0)  # one voxel, its centre beside the ball
    grid = back_project(regions, cameras, config=coarse)
    assert grid is not None
    assert not grid.occupied.any()
    assert grid.volume == 0
    assert len(grid.mesh().vertices) == 0
    with warns_of("no_shape"):
        assert reconstruct_instances(regions, regions.labels, cameras, config=coarse) == {}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"threshold": 1.0}, "threshold is 1, expected"),
        ({"seen_share": -0.1}, "seen_share is -0.1, expected"),
        ({"voxel_size": 0.0}, "voxel_size is 0, expected"),
        ({"voxel_size": float("nan")}, "voxel_size is nan, expected"),
        ({"voxel_budget": 0}, "voxel_budget is 0, expected"),
        ({"voxel_size": 1e-5}, "voxels, expected at most"),
    ],
)
def test_impossible_resolutions_are_refused(config: dict[str, float], message: str) -> None:
    regions, cameras = ball_from(AXES[:2])
    with pytest.raises(InputError, match=message):
        back_project(regions, cameras, config=ReconstructConfig(**config))


def test_a_minority_of_wrong_masks_does_not_cost_the_shape() -> None:
    """Two of eight masks belong to a ball far away, so that the rays' nearest point is off the first ball."""
    cameras = cameras_at(arc_positions(8, distance=400.0), focal=400.0)
    centers, radii = torch.tensor([[-30.0, 0, 0], [30.0, 0, 0]]).double(), torch.tensor([1.5, 1.5]).double()
    regions = regions_from_label_maps(render_balls(cameras, centers, radii))
    mixed = torch.where(regions.view_index < 6, 1, 2)
    grid = back_project(regions.select(regions.labels == mixed), cameras)
    assert grid is not None
    torch.testing.assert_close(grid.points.mean(0), centers[0], atol=0.5, rtol=0)


def test_masks_without_a_pixel_do_not_vote_and_ids_must_fit() -> None:
    regions, cameras = ball_from(AXES)
    nothing = torch.zeros_like(regions.crop(2)).flatten()
    crops = torch.cat((regions.crop(0).flatten(), regions.crop(1).flatten(), nothing))
    emptied = Regions(regions.view_index, regions.boxes, crops, 3, regions.labels)
    grid = back_project(emptied, cameras, config=ReconstructConfig(voxel_size=0.1))
    assert grid is not None
    assert grid.num_views == 2
    with pytest.raises(InputError, match="2 instance ids for 3 regions"):
        reconstruct_instances(regions, torch.tensor([1, 1]), cameras)


def pieces_grid(*, crumb: int) -> VoxelGrid:
    """Blocks of 1000 and 100 voxels, and a rod of `crumb` voxels that shares an edge with the first."""
    votes = torch.zeros(30, 30, 40)
    votes[2:12, 2:12, 2:12] = 1
    votes[20:24, 20:25, 20:25] = 0.75
    votes[12, 12, 5 : 5 + crumb] = 1
    votes[26:, :, :] = 0.5  # not occupied
    return VoxelGrid(torch.tensor([1.0, 2.0, 3.0]).double(), 0.5, votes, 4, 0.5)


def test_pieces_are_those_of_the_mesh() -> None:
    for crumb, pieces in ((30, 3), (0, 2)):
        grid = pieces_grid(crumb=crumb)
        assert grid.num_pieces == len(grid.mesh().split()) == pieces
    votes = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(3))
    noise = VoxelGrid(torch.zeros(3).double(), 0.5, (votes > 0.8).float(), 4, 0.5)
    outward = [part for part in noise.mesh().split(only_watertight=False) if part.volume > 0]  # others are cavities
    assert noise.num_pieces == len(outward) > 10
    empty = VoxelGrid(torch.zeros(3).double(), 0.5, torch.zeros(3, 3, 3), 4, 0.5)
    assert empty.num_pieces == 0
    assert empty.without_crumbs() is empty


def test_crumbs_are_gone_from_points_volume_and_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    """A crumb has less than 2 % of the largest piece: 19 of 1000 voxels."""
    with_crumb, kept = pieces_grid(crumb=19), pieces_grid(crumb=20)
    swept = with_crumb.without_crumbs()
    assert (with_crumb.num_pieces, swept.num_pieces) == (3, 2)
    assert kept.without_crumbs() is kept
    assert len(with_crumb.points) - len(swept.points) == 19
    assert with_crumb.volume - swept.volume == pytest.approx(19 * 0.5**3)
    assert len(swept.mesh().split()) == len(with_crumb.mesh().split()) - 1
    assert torch.equal(swept.votes, pieces_grid(crumb=0).votes)
    monkeypatch.setattr("mvseg.reconstruction.voxels.VOXELS", replace(VOXELS, crumb=0.5))
    assert swept.without_crumbs().num_pieces == 1
