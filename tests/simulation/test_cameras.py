"""Cameras around plants: what they see, and where they stand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.simulation.cameras import FRAME_FILL, arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant


@pytest.fixture(scope="module")
def plant() -> SimulatedPlant:
    return grow_plant("ovate", 12, seed=2)


@pytest.mark.parametrize("size", [(480, 480), (320, 200), (100, 300)])
def test_the_farthest_point_of_leaves_and_stems_fills_the_frame(plant: SimulatedPlant, size: tuple[int, int]) -> None:
    cameras = arc_cameras(5, plant, width=size[0], height=size[1])
    stems = [part.vertices for part in plant.parts if part.material == "stem"]
    px, depth = cameras.project(torch.from_numpy(np.concatenate([leaf.vertices for leaf in plant.leaves] + stems)))
    assert (depth > 0).all()
    half = torch.tensor(size) / 2
    assert ((px - half).abs() / half).max().item() == pytest.approx(FRAME_FILL)


def test_arc_spans_its_angle_at_its_elevations_around_one_point(plant: SimulatedPlant) -> None:
    cameras = arc_cameras(5, plant, start_deg=30)
    center = torch.linalg.lstsq(
        cameras.R[:, :2].reshape(-1, 3), -cameras.t[:, :2].reshape(-1, 1)
    ).solution.ravel()  # all optical axes meet here
    offset = cameras.centers - center
    assert torch.allclose(offset.norm(dim=1), offset.norm(dim=1)[:1].expand(5))
    azimuth = np.unwrap(torch.atan2(offset[:, 1], offset[:, 0]).numpy())
    assert np.allclose(np.degrees(azimuth - azimuth[0]), [0, 50, 100, 150, 200])
    assert np.degrees(azimuth[0]) == pytest.approx(30)
    elevation = torch.asin(offset[:, 2] / offset.norm(dim=1))
    assert np.allclose(np.degrees(elevation.numpy()), [20, 50, 20, 50, 20])
    assert (cameras.R[:, 1, 2] < 0).all()  # upright: image down is world down


def test_ring_has_no_camera_twice_and_one_view_is_enough(plant: SimulatedPlant) -> None:
    ring = arc_cameras(4, plant, span_deg=360, elevations_deg=(0.0,))
    gaps = torch.cdist(ring.centers, ring.centers) + 1e9 * torch.eye(4, dtype=torch.float64)
    assert gaps.min() == pytest.approx(gaps[0, 1].item())
    assert len(arc_cameras(1, plant)) == 1
