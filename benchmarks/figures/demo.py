"""Draws docs/demo.jpg from the result of the shipped scene: `python infer.py && python benchmarks/figures/demo.py`"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

ROOT = Path(__file__).parents[2]
HEIGHT = 300  # pixels of each picture


def read_scaled(path: Path) -> np.ndarray:
    """(HEIGHT, W, 3) BGR."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return cv2.resize(image, (round(HEIGHT * image.shape[1] / image.shape[0]), HEIGHT), interpolation=cv2.INTER_AREA)


def draw_meshes(path: Path, azimuth_deg: float, elevation_deg: float = 20.0) -> np.ndarray:
    """(HEIGHT, HEIGHT, 3) BGR: the meshes of a GLB in parallel projection, shaded by their normals, world +z up."""
    parts = list(trimesh.load_scene(path).geometry.values())
    mesh = trimesh.util.concatenate(parts)
    colors = np.concatenate([np.repeat(part.visual.vertex_colors[:1, :3], len(part.faces), 0) for part in parts])
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    away = level * np.cos(elevation) + np.array([0, 0, np.sin(elevation)])
    right = np.array([-level[1], level[0], 0])
    up = np.cross(away, right)
    center, half = mesh.bounds.mean(0), 0.36 * np.linalg.norm(np.diff(mesh.bounds, axis=0))
    x, y = np.meshgrid(np.linspace(-half, half, 2 * HEIGHT), np.linspace(half, -half, 2 * HEIGHT))
    origins = (center + 9 * half * away + x[..., None] * right + y[..., None] * up).reshape(-1, 3)
    face = RayMeshIntersector(mesh).intersects_first(origins, np.broadcast_to(-away, origins.shape))
    image = np.full((len(origins), 3), 255.0)
    hit = face >= 0
    light = np.abs(mesh.face_normals[face[hit]] @ (0.8 * away + 0.6 * up))
    image[hit] = colors[face[hit]] * (0.3 + 0.7 * light[:, None])
    image = image.reshape(2 * HEIGHT, 2 * HEIGHT, 3)[..., ::-1].clip(0, 255).astype(np.uint8)
    return cv2.resize(image, (HEIGHT, HEIGHT), interpolation=cv2.INTER_AREA)


def main() -> None:
    result = ROOT / "results" / "demo_plant"
    views = ("001", "004", "007")
    photos = [read_scaled(ROOT / "mvseg" / "demo_plant" / "images" / f"{view}.jpg") for view in views]
    overlays = [read_scaled(result / "overlay" / f"{view}.png") for view in views]
    meshes = [draw_meshes(result / "scene.glb", azimuth) for azimuth in (30, 110)]
    rows = [np.concatenate([*row, mesh], 1) for row, mesh in zip((photos, overlays), meshes, strict=True)]
    cv2.imwrite(str(ROOT / "docs" / "demo.jpg"), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
