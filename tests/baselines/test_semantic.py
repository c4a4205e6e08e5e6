from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.baselines.semantic import reconstruct_semantic
from mvseg.errors import InputError
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras, Scene, View
from reference import back_project_reference
from synthetic import BallScene, ball_scene


def scene_of(cameras: Cameras) -> Scene:
    return Scene("balls", tuple(View(str(view), Path(f"{view}.png")) for view in range(len(cameras))), cameras)


@pytest.fixture(scope="module")
def balls() -> BallScene:
    return ball_scene(4, 10, seed=1)


def test_holds_the_balls_and_little_else(balls: BallScene) -> None:
    config = ReconstructConfig(threshold=0.9, voxel_size=0.05)
    grid = reconstruct_semantic(balls.regions, scene_of(balls.cameras), config)
    assert grid is not None
    distance = torch.cdist(grid.points, balls.centers)
    assert (distance.min(0).values < 0.05).all()
    assert ((distance / balls.radii).min(1).values < 1.2).double().mean() > 0.8


def test_votes_are_those_of_the_union_of_all_masks(balls: BallScene) -> None:
    grid = reconstruct_semantic(balls.regions, scene_of(balls.cameras), ReconstructConfig(voxel_budget=2000))
    assert grid is not None
    generator = torch.Generator().manual_seed(0)
    voxels = torch.stack([torch.randint(side, (60,), generator=generator) for side in grid.votes.shape], 1)
    points = grid.origin + grid.voxel_size * (voxels + 0.5)
    expected = back_project_reference(balls.regions, balls.cameras, points)
    torch.testing.assert_close(grid.votes[tuple(voxels.T)], expected)
    assert grid.num_views == 10


def test_threshold_is_that_of_the_config(balls: BallScene) -> None:
    volumes = []
    for threshold in (0.3, 0.5, 0.9):
        config = ReconstructConfig(threshold=threshold, voxel_size=0.1)
        grid = reconstruct_semantic(balls.regions, scene_of(balls.cameras), config)
        assert grid is not None
        assert grid.threshold == threshold
        volumes.append(grid.volume)
    assert volumes == sorted(volumes, reverse=True)
    assert volumes[0] > volumes[2]


def test_order_of_regions_changes_nothing(balls: BallScene) -> None:
    order = torch.randperm(len(balls.regions), generator=torch.Generator().manual_seed(0))
    config = ReconstructConfig(voxel_size=0.1)
    first, second = (
        reconstruct_semantic(regions, scene_of(balls.cameras), config)
        for regions in (balls.regions, balls.regions.select(order))
    )
    assert first is not None
    assert second is not None
    assert torch.equal(first.votes, second.votes)


def test_nothing_to_see_gives_nothing(balls: BallScene) -> None:
    once = regions_from_label_maps([balls.label_maps[0], *(0 * labels for labels in balls.label_maps[1:])])
    assert reconstruct_semantic(once, scene_of(balls.cameras)) is None


def test_wrong_number_of_views_is_refused(balls: BallScene) -> None:
    with pytest.raises(InputError, match="regions of 10 views with 9 cameras"):
        reconstruct_semantic(balls.regions, scene_of(balls.cameras[list(range(9))]))
