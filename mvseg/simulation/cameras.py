"""Cameras around simulated plants."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.scene import Cameras
from mvseg.simulation.growth import SimulatedPlant

FRAME_FILL = 0.94  # chosen: share of the half image that the farthest point of the plant reaches
DISTANCE = 3.5  # chosen: from the cameras to the plant's centre, in radii of the plant


def arc_cameras(
    num_views: int,
    plant: SimulatedPlant,
    *,
    span_deg: float = 200.0,
    start_deg: float = 0.0,
    elevations_deg: tuple[float, ...] = (20.0, 50.0),
    width: int = 480,
    height: int = 480,
) -> Cameras:
    """Cameras on an arc around a plant, all looking at its centre, with one focal length that fills the frame.

    Args:
        num_views: >= 1, evenly spread over the arc.
        plant: its leaves and stems are inside every image; pot, soil and ground may not be.
        span_deg: azimuth from the first to the last camera, above 0; 360 is a full ring without a doubled camera.
        start_deg: azimuth of the first camera.
        elevations_deg: above the horizon, taken in turn by the views; above -90 and below 90.
    """
    stems = [part.vertices for part in plant.parts if part.material == "stem"]
    points = np.concatenate([*(leaf.vertices for leaf in plant.leaves), *stems])
    center = (points.min(0) + points.max(0)) / 2
    distance = DISTANCE * float(np.linalg.norm(points - center, axis=1).max())
    gaps = max(num_views - 1, 1) if span_deg < 360 else num_views
    azimuths = np.radians(start_deg + span_deg * np.arange(num_views) / gaps)
    elevations = np.radians(np.resize(elevations_deg, num_views))
    rotations = np.stack([look_at(a, e) for a, e in zip(azimuths, elevations, strict=True)])
    translations = np.array([0.0, 0.0, distance]) - rotations @ center
    cam = np.einsum("vij,pj->vpi", rotations, points) + translations[:, None]
    slope = np.abs(cam[..., :2] / cam[..., 2:]).max((0, 1))
    focal = FRAME_FILL * min(width / 2 / slope[0], height / 2 / slope[1])
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    every_K, R, t = map(torch.from_numpy, (np.repeat(K[None], num_views, 0), rotations, translations))
    return Cameras(K=every_K, R=R, t=t, sizes=torch.tensor([[width, height]] * num_views))


def look_at(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """(3, 3) rotation of cam_from_world of an upright camera that looks at the origin from these angles (radians)."""
    level = math.cos(elevation)
    outwards = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    return np.stack([right, np.cross(-outwards, right), -outwards])
