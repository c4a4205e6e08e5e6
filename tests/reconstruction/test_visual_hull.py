from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.reconstruction.visual_hull import Silhouettes, halve_cells
from synthetic import BallScene, ball_scene

THRESHOLD = 0.5


def silhouettes_of(scene: BallScene, label: int) -> Silhouettes:
    """Of one ball, as crops of different sizes."""
    regions = scene.regions.select(scene.regions.labels == label)
    matrices = scene.cameras.px_from_world[regions.view_index].clone()
    matrices[:, :2] -= regions.boxes[:, :2, None] * matrices[:, 2:]
    return Silhouettes(tuple(regions.crop(row) for row in range(len(regions))), matrices)


@pytest.fixture(scope="module")
def silhouettes() -> Silhouettes:
    scene = ball_scene(4, 6, seed=1)
    found = silhouettes_of(scene, int(scene.regions.labels[0]))
    assert len({mask.shape for mask in found.masks}) > 1
    return found


def is_shown(silhouettes: Silhouettes, points: torch.Tensor) -> torch.Tensor:
    """(S, P) bool, point by point: does a mask show it?"""
    shown = []
    for mask, matrix in zip(silhouettes.masks, silhouettes.px_from_world, strict=True):
        for point in points:
            x, y, depth = (matrix[:, :3] @ point + matrix[:, 3]).tolist()
            column, row = int(np.floor(x / depth)), int(np.floor(y / depth))
            inside = depth > 0 and 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]
            shown.append(inside and bool(mask[row, column]))
    return torch.tensor(shown).reshape(len(silhouettes), -1)


@pytest.mark.parametrize("radius", [0.05, 1.0, 20.0])
def test_a_ball_meets_each_mask_that_shows_one_of_its_points(silhouettes: Silhouettes, radius: float) -> None:
    """Also where it reaches behind the cameras: they are ten units away."""
    generator = torch.Generator().manual_seed(0)
    within = torch.randn(300, 3, generator=generator, dtype=torch.float64)
    within *= (torch.rand(300, 1, generator=generator, dtype=torch.float64) ** (1 / 3)) / within.norm(dim=1)[:, None]
    shift = 3 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    points = silhouettes.middle + torch.where(torch.arange(300)[:, None] < 150, 0.02, 1.0) * shift
    shown = is_shown(silhouettes, points)
    met = torch.stack([silhouettes.may_meet((point - radius * away)[None], radius)[:, 0]
                       for point, away in zip(points, within, strict=True)], 1)  # fmt: skip
    assert shown.any(1).all()
    assert met[shown].all()


def test_small_balls_beside_a_mask_do_not_meet_it(silhouettes: Silhouettes) -> None:
    beside = silhouettes.middle + torch.tensor([[0.0, 0.0, 50.0], [0.0, 0.0, -50.0]], dtype=torch.float64)
    assert not silhouettes.may_meet(beside, 0.05).any()


def test_no_point_that_enough_masks_show_is_left_out_of_the_cells(silhouettes: Silhouettes) -> None:
    """At every size of cells, and these get fewer than those of the whole cube."""
    generator = torch.Generator().manual_seed(1)
    points = silhouettes.middle + 0.5 * torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    points = points[is_shown(silhouettes, points).sum(0) > THRESHOLD * len(silhouettes)]
    assert len(points) > 50
    for level, cells in enumerate(halve_cells(silhouettes, THRESHOLD), start=1):
        places = ((points - cells.corner) / cells.size).floor().long()
        assert {*map(tuple, places.tolist())} <= {*map(tuple, cells.indices.tolist())}
        low, high = cells.box
        assert (low <= points).all()
        assert (points <= high).all()
        if level == 8:
            break
    assert len(cells) < 0.001 * 8**level
