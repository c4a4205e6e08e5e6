"""Draws docs/demo.jpg from the result of the shipped scene: `python infer.py && python -m benchmarks.figures.demo`"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from mvseg.formats.image_file import read_rgb
from mvseg.formats.label_png import read_labels

ROOT = Path(__file__).parents[2]
VIEWS = ("003", "004", "007")
HEIGHT = 330  # pixels of each picture
MARGIN = 0.12  # around the plant, of its longer side
FINE = 3  # small pixels per pixel, along a side, of drawn leaves
PAPER, RIM = (255.0, 255.0, 255.0), 0.45  # the rim's share of a leaf's brightness


def find_box(labels: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around all leaves of a label image, in the proportions of the photo."""
    size = np.array(labels.shape)
    places = np.argwhere(labels > 0)
    low, high = places.min(0), places.max(0) + 1
    wanted = size * min(1.0, float(((1 + 2 * MARGIN) * (high - low) / size).max()))
    start = np.clip((low + high - wanted) / 2, 0, size - wanted).round().astype(int)
    end = (start + wanted).round().astype(int)
    return slice(start[0], end[0]), slice(start[1], end[1])


def read_cropped(path: Path, labels: np.ndarray) -> np.ndarray:
    """(HEIGHT, W, 3) BGR, around the plant."""
    image = np.ascontiguousarray(read_rgb(path)[..., ::-1])
    width = round(HEIGHT * image.shape[1] / image.shape[0])
    return cv2.resize(image[find_box(labels)], (width, HEIGHT), interpolation=cv2.INTER_CUBIC)


def draw_meshes(path: Path, azimuth_deg: float, elevation_deg: float = 25.0) -> np.ndarray:
    """(HEIGHT, HEIGHT, 3) BGR: the meshes of a GLB in parallel projection, shaded by their normals, +y up."""
    scene = trimesh.load_scene(path)
    parts: list[Any] = [scene.geometry[scene.graph[name][1]].copy() for name in scene.graph.nodes_geometry]
    for part, name in zip(parts, scene.graph.nodes_geometry, strict=True):
        part.apply_transform(scene.graph[name][0])
    linear = np.array([part.visual.material.baseColorFactor[:3] for part in parts]) / 255  # as glTF has it
    colors = 255 * linear ** (1 / 2.2)
    owner = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    mesh: Any = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts])
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    away = level * np.cos(elevation) + np.array([0, np.sin(elevation), 0])
    right = np.array([np.sin(azimuth), 0, np.cos(azimuth)]) * -1
    up = np.cross(away, right)
    seen = mesh.vertices @ np.stack([right, up, away], 1)
    low, high = seen.min(0), seen.max(0)
    half = 0.56 * (high - low)[:2].max()
    center = (low + high) / 2
    side = FINE * HEIGHT
    x, y = np.meshgrid(center[0] + np.linspace(-half, half, side), center[1] + np.linspace(half, -half, side))
    origins = x[..., None] * right + y[..., None] * up + (high[2] + half) * away
    face = RayMeshIntersector(mesh).intersects_first(
        origins.reshape(-1, 3), np.broadcast_to(-away, origins.shape).reshape(-1, 3)
    )
    leaf = np.where(face >= 0, owner[face], -1).reshape(side, side)
    light = np.abs(mesh.face_normals[face] @ (0.35 * away + 0.8 * up + 0.5 * right)).reshape(side, side)
    image = colors[leaf] * (0.3 + 0.75 * light.clip(0, 1))[..., None]
    edge = cv2.morphologyEx((leaf + 1).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    image[edge] *= RIM
    image[leaf < 0] = PAPER
    image = image[..., ::-1].clip(0, 255).astype(np.uint8)
    return cv2.resize(image, (HEIGHT, HEIGHT), interpolation=cv2.INTER_AREA)


def main() -> None:
    result = ROOT / "results" / "demo_plant"
    labels = [read_labels(result / "labels" / f"{view}.png") for view in VIEWS]
    places = list(zip(VIEWS, labels, strict=True))
    images = ROOT / "mvseg" / "demo_plant" / "images"
    photos = [read_cropped(images / f"{view}.jpg", label) for view, label in places]
    overlays = [read_cropped(result / "overlay" / f"{view}.png", label) for view, label in places]
    meshes = [draw_meshes(result / "scene.glb", azimuth) for azimuth in (30, 110)]
    rows = [np.concatenate([*row, mesh], 1) for row, mesh in zip((photos, overlays), meshes, strict=True)]
    cv2.imwrite(str(ROOT / "docs" / "demo.jpg"), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
