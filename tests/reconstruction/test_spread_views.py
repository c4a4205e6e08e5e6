"""Views that are evenly spread by direction: laws, and a slow twin that tries every choice."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from blade_scene import ring_cameras
from mvseg.reconstruction.numbers import RAYS
from mvseg.reconstruction.spread_views import spread_views
from mvseg.scene import Cameras, nearest_point


def scattered(num_views: int, seed: int) -> Cameras:
    """Cameras at any height, all around and at changing distances, that look nearly at one point."""
    rng = np.random.default_rng(seed)
    ring = ring_cameras(num_views, elevations_deg=tuple(rng.uniform(5, 80, num_views)))
    order, scale = rng.permutation(num_views), torch.from_numpy(rng.uniform(0.5, 2, num_views))
    turns = torch.from_numpy(Rotation.from_rotvec(0.02 * rng.normal(size=(num_views, 3))).as_matrix())
    R, t = turns @ ring.R, (turns @ (scale[:, None] * ring.t)[:, :, None])[..., 0]
    return Cameras(K=ring.K, R=R, t=t, sizes=ring.sizes)[order]


def crowding(cameras: Cameras, chosen: tuple[int, ...]) -> float:
    """The sum of 1 / (d^2 + `RAYS.same`^2) over pairs of chosen directions, in plain loops."""
    target = nearest_point(cameras.centers, cameras.R[:, 2])
    ways = [(center - target) / (center - target).norm() for center in cameras.centers]
    pairs = combinations(chosen, 2)
    return sum(1 / (float(((ways[i] - ways[j]) ** 2).sum()) + RAYS.same**2) for i, j in pairs)


@pytest.mark.parametrize(("num_views", "most"), [(9, 3), (10, 4), (8, 5), (9, 2), (7, 1)])
@pytest.mark.parametrize("seed", range(3))
def test_no_exchange_is_better_and_hardly_any_other_choice(num_views: int, most: int, seed: int) -> None:
    cameras = scattered(num_views, seed)
    chosen = tuple(spread_views(cameras, most).tolist())
    assert len(set(chosen)) == most
    others = [each for each in combinations(range(num_views), most) if len({*each} & {*chosen}) == most - 1]
    assert crowding(cameras, chosen) <= min(crowding(cameras, each) for each in others) * (1 + 1e-5)
    best = min(crowding(cameras, each) for each in combinations(range(num_views), most))
    assert crowding(cameras, chosen) <= 1.2 * best


@pytest.mark.parametrize("most", [4, 5, 9, 15])
def test_of_a_ring_every_so_many_are_taken(most: int) -> None:
    """Whichever neighbours are equally good."""
    chosen = spread_views(ring_cameras(45, elevations_deg=(35,)), most)
    gaps = torch.cat((chosen, chosen[:1] + 45)).diff()
    assert {*gaps.tolist()} <= {45 // most, -(-45 // most)}


def test_the_order_of_the_views_does_not_matter() -> None:
    cameras = scattered(12, seed=5)
    for most in range(2, 13):
        order = torch.from_numpy(np.random.default_rng(most).permutation(12))
        assert order[spread_views(cameras[order], most)].sort().values.tolist() == spread_views(cameras, most).tolist()


def test_neither_the_world_nor_the_last_bits_matter() -> None:
    """Of a ring, where many choices are equally good."""
    cameras = ring_cameras(24)
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix())
    R, scale, shift = cameras.R @ turn.mT, 17.3, torch.tensor([1e3, -5.0, 70.0], dtype=torch.float64)
    t = scale * cameras.t - (R @ shift[:, None])[..., 0]
    moved = Cameras(K=2 * cameras.K - torch.diag(torch.tensor([0, 0, 1.0])), R=R, t=t, sizes=2 * cameras.sizes)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(24, 3)))
    shaken = Cameras(K=cameras.K, R=cameras.R, t=cameras.t + 1e-10 * noise, sizes=cameras.sizes)
    for most in range(2, 24):
        expected = spread_views(cameras, most).tolist()
        assert spread_views(moved, most).tolist() == expected
        assert spread_views(shaken, most).tolist() == expected


def test_all_are_taken_where_there_are_no_more_and_views_from_one_place_count_as_one() -> None:
    cameras = ring_cameras(6)
    assert spread_views(cameras, 6).tolist() == spread_views(cameras, 99).tolist() == [0, 1, 2, 3, 4, 5]
    assert spread_views(cameras[[0]], 1).tolist() == [0]
    # A burst, and cameras at other distances in the same direction, add nothing.
    ring = ring_cameras(6)
    burst = ring[[0, 0, 0, 1, 2, 2, 3, 4, 5]]
    far = Cameras(K=burst.K, R=burst.R, t=burst.t * torch.linspace(1, 3, 9)[:, None], sizes=burst.sizes)
    for cameras in (burst, far):
        chosen = spread_views(cameras, 6)
        assert torch.tensor([0, 0, 0, 1, 2, 2, 3, 4, 5])[chosen].tolist() == [0, 1, 2, 3, 4, 5]


def test_cameras_that_look_the_same_way_are_spread_over_their_places() -> None:
    ring = ring_cameras(9)
    R = ring.R[[0] * 9]
    across = torch.stack((torch.arange(9.0) % 3, torch.arange(9) // 3, torch.full((9,), 9.0)), 1).double()
    cameras = Cameras(K=ring.K, R=R, t=-across, sizes=ring.sizes)
    assert spread_views(cameras, 4).tolist() == [0, 2, 6, 8]
    assert spread_views(cameras, 5).tolist() == [0, 2, 4, 6, 8]
