"""Occupancy of a level sheet on which a disc with a hole is leaf: its area is exact by construction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from known_leaves import flat_leaf
from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import OCCUPANCY
from mvseg.reconstruction.surface.leaf_surface import Occupancy, cell_normals
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.reconstruction.surface.occupancy import measure_occupancy
from mvseg.reconstruction.surface.patch_image import project_points
from mvseg.results.shapes_file import read_surfaces, write_surfaces
from mvseg.traits.leaf import measure_leaf

SIZE = 240
AREA = np.pi * (0.8**2 - 0.3**2)
ALONG, ACROSS = np.meshgrid(*(np.linspace(-1, 1, count + 1) for count in OCCUPANCY.cells), indexing="ij")
SHEET = np.stack([ALONG, ACROSS, 0 * ALONG], -1)


def is_leaf(x: Floats, y: Floats) -> Floats:
    return (np.hypot(x, y) < 0.8) & (np.hypot(x - 0.3, y) > 0.3)


def view_disc(num_views: int = 8) -> MaskStack:
    """Masks of the disc by cameras around it, from above: each pixel shows the point of the plane z = 0 behind it."""
    matrices = []
    for turn in 2 * np.pi * np.arange(num_views) / num_views:
        back = np.array([np.cos(turn), np.sin(turn), 1.2])
        ahead, right = -back / np.linalg.norm(back), np.array([-np.sin(turn), np.cos(turn), 0])
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        px_from_cam = np.array([[400.0, 0, SIZE / 2], [0, 400, SIZE / 2], [0, 0, 1]])
        matrices.append(px_from_cam @ np.concatenate([rotation, -rotation @ (3 * back)[:, None]], 1))
    px = np.stack([*np.meshgrid(*2 * [np.arange(SIZE) + 0.5]), np.ones((SIZE, SIZE))], -1)
    planes = [px @ np.linalg.inv(each[:, [0, 1, 3]]).T for each in matrices]
    masks = [is_leaf(each[..., 0] / each[..., 2], each[..., 1] / each[..., 2]) for each in planes]
    others = [np.zeros((SIZE, SIZE), np.int32)] * num_views
    return stack_masks(masks, others, range(num_views), px_from_world=np.array(matrices))


def test_area_is_that_of_the_leaf_and_the_hole_stays_open() -> None:
    occupancy = measure_occupancy(view_disc(), SHEET)
    assert occupancy.area == pytest.approx(AREA, rel=0.02)
    assert abs(occupancy.area - AREA) < 1.96 * occupancy.sd < 0.1 * AREA
    middles = (SHEET[1:, 1:] + SHEET[:-1, :-1]) / 2
    assert (occupancy.is_leaf == is_leaf(middles[..., 0], middles[..., 1])).mean() > 0.98
    assert (occupancy.flip(0, 1).is_leaf == occupancy.is_leaf[::-1, ::-1]).all()


def test_what_hides_the_leaf_says_nothing_and_areas_scale() -> None:
    masks = view_disc()
    hidden = replace(masks, inside=masks.inside.copy(), others=masks.others.copy())
    hidden.inside[:2], hidden.others[:2] = False, 7
    assert measure_occupancy(hidden, SHEET).area == pytest.approx(AREA, rel=0.02)
    matrices = masks.px_from_world * np.array([0.1, 0.1, 0.1, 1])
    larger = measure_occupancy(replace(masks, px_from_world=matrices), 10 * SHEET)
    once = measure_occupancy(masks, SHEET)
    assert (larger.area, larger.sd) == pytest.approx((100 * once.area, 100 * once.sd))


def test_votes_one_by_one() -> None:
    """A slow twin of some cells: the odds of each view that sees the middle of a cell."""
    masks = view_disc()
    shares, normals = measure_occupancy(masks, SHEET).shares.numpy(), cell_normals(SHEET)
    for row, column in ((5, 5), (40, 30), (64, 20), (70, 41), (84, 32), (100, 50)):
        middle, normal = SHEET[row : row + 2, column : column + 2].mean((0, 1)), normals[row, column]
        odds = 1.0
        for view, matrix in enumerate(masks.px_from_world):
            ray = middle + np.linalg.solve(matrix[:, :3], matrix[:, 3])
            cosine = abs(ray @ normal) / np.linalg.norm(ray) / np.linalg.norm(normal)
            x, y = project_points(matrix[None], middle[None, None]).px[0, 0, 0]
            vote = 1 if masks.inside[view, int(y), int(x)] else -1
            odds *= ((1 - OCCUPANCY.vote_error) / OCCUPANCY.vote_error) ** (vote * cosine)
        assert shares[row, column] == pytest.approx(odds / (1 + odds), rel=1e-5)


def test_results_keep_occupancy(tmp_path: Path) -> None:
    """The mesh has the share of faces that the leaf covers; an area is what it was."""
    shares = torch.zeros(OCCUPANCY.cells)
    shares[: OCCUPANCY.cells[0] // 2] = 1
    whole = flat_leaf()
    surface = replace(whole, occupancy=Occupancy(shares, whole.area / 2, 0.5))
    write_surfaces(tmp_path / "surfaces.npz", {1: whole, 2: surface})
    first, second = read_surfaces(tmp_path / "surfaces.npz").values()
    assert first.occupancy is None
    assert (second.area, second.deviations[0]) == (surface.area, 0.5)
    assert second.mesh().area == pytest.approx(whole.area / 2, rel=0.01)
    assert measure_leaf(second, None)["area"].method == "surface, occupancy"
