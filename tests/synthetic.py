"""Analytic scenes: balls, whose silhouettes, occlusions and positions are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class BallScene:
    """Balls seen by cameras."""

    cameras: Cameras
    centers: Tensor  # (K, 3)
    radii: Tensor
    label_maps: list[np.ndarray]  # (H, W), 0 = nothing, k + 1 = the nearest ball is k
    regions: Regions  # the visible parts; labels - 1 is the ball


def look_at(position: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """R, t of cam_from_world for a camera at `position` that looks at `target`, world +z up."""
    forward = torch.nn.functional.normalize(target - position, dim=0)
    up = torch.tensor([0.0, 0.0, 1.0]).to(position)
    if forward.dot(up).abs() > 0.999:
        up = torch.tensor([0.0, 1.0, 0.0]).to(position)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    R = torch.stack((right, torch.linalg.cross(forward, right), forward))
    return R, -R @ position


def cameras_at(
    positions: Tensor, *, focal: float = 400.0, width: int = 320, height: int = 240, target: Tensor | None = None
) -> Cameras:
    """Cameras at (V, 3) positions that look at one point (the origin)."""
    target = torch.zeros(3).double() if target is None else target
    poses = [look_at(position, target) for position in positions.double()]
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).double()
    R, t = (torch.stack(part) for part in zip(*poses, strict=True))
    return Cameras(K.expand(len(R), 3, 3).clone(), R, t, torch.tensor([[width, height]] * len(R)))


def arc_positions(num_views: int, *, distance: float = 10.0, span: float = 200.0) -> Tensor:
    """(V, 3) positions on an arc, at 20 and 50 degrees of elevation in turn."""
    azimuth = torch.deg2rad(torch.linspace(0, span, num_views).double())
    elevation = torch.deg2rad(torch.tensor([20.0, 50.0]).double()[torch.arange(num_views) % 2])
    level = elevation.cos() * distance
    return torch.stack((level * azimuth.cos(), level * azimuth.sin(), elevation.sin() * distance), 1)


def render_balls(cameras: Cameras, centers: Tensor, radii: Tensor) -> list[np.ndarray]:
    """Label maps of the nearest ball along the ray through every pixel's centre."""
    label_maps = []
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        labels, nearest = np.zeros((height, width), np.int64), np.full((height, width), np.inf)
        offsets, world_from_px = (centers.double() - cameras.centers[view]).numpy(), cameras.world_from_px[view].numpy()
        for ball, (offset, radius) in enumerate(zip(offsets, radii.double().tolist(), strict=True), start=1):
            rows, columns = window = _window(cameras, view, centers[ball - 1].double(), radius)
            v, u = np.mgrid[rows, columns] + 0.5
            rays = np.stack((u, v, np.ones_like(u)), -1) @ world_from_px.T
            along = rays @ offset / np.linalg.norm(rays, axis=-1)
            missed = offset @ offset - along**2 - radius**2
            depth = np.where((missed < 0) & (along > 0), along - np.sqrt(np.maximum(-missed, 0)), np.inf)
            is_nearest = depth < nearest[window]
            labels[window][is_nearest], nearest[window][is_nearest] = ball, depth[is_nearest]
        label_maps.append(labels)
    return label_maps


def _window(cameras: Cameras, view: int, center: Tensor, radius: float) -> tuple[slice, slice]:
    """Rows and columns that hold all that a view shows of a ball."""
    width, height = cameras.sizes[view].tolist()
    cam = cameras.R[view] @ center + cameras.t[view]
    depth = float(cam[2])
    if depth <= radius:
        return slice(0, height if depth > -radius else 0), slice(0, width)
    x, y = (cameras.K[view] @ cam / depth)[:2].tolist()
    reach = float(cameras.K[view, :2, :2].norm()) * radius / (depth - radius) * float(cam.norm()) / depth + 1
    rows, columns = np.clip([[y - reach, y + reach], [x - reach, x + reach]], 0, [[height], [width]]).astype(int)
    return slice(*rows), slice(*columns)


def ball_scene(
    num_balls: int, num_views: int, *, seed: int = 0, radius: float = 0.35, spread: float = 1.6, **camera: int | float
) -> BallScene:
    """Random balls around the origin, on the usual arc of cameras."""
    generator = torch.Generator().manual_seed(seed)
    centers = (torch.rand(num_balls, 3, generator=generator).double() - 0.5) * 2 * spread
    radii = radius * (0.6 + 0.8 * torch.rand(num_balls, generator=generator).double())
    cameras = cameras_at(arc_positions(num_views), **camera)
    label_maps = render_balls(cameras, centers, radii)
    return BallScene(cameras, centers, radii, label_maps, regions_from_label_maps(label_maps))


def permute_views(scene: BallScene, order: list[int]) -> BallScene:
    maps = [scene.label_maps[view] for view in order]
    return BallScene(scene.cameras[order], scene.centers, scene.radii, maps, regions_from_label_maps(maps))


def moved(cameras: Cameras, scale: float, rotation: Tensor, shift: Tensor) -> Cameras:
    """The same photos in a world that was moved: x' = scale * rotation @ x + shift."""
    R = cameras.R @ rotation.T
    return Cameras(cameras.K, R, scale * cameras.t - (R @ shift[:, None])[:, :, 0], cameras.sizes)
