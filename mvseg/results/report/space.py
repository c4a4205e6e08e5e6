"""The 3D view of the page: the leaves as small meshes, and the cameras. In the page's frame +y is up, the middle of the
plant is at the origin, and all leaves are within a radius of 1."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh

from mvseg.arrays import Floats
from mvseg.formats.mesh import simplify_mesh
from mvseg.reconstruction.shapes import best_shape
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.results.result import Result
from mvseg.results.stem_shapes import StemPart, parts_of
from mvseg.scene import Cameras, Scene, nearest_point
from mvseg.traits.stems import find_upward
from mvseg.traits.up import level_frame

MESH_SHAPE = (24, 9)  # limit: grid of a surface: 352 triangles
VOXEL_FACES = 700  # limit: max. triangles of a leaf of voxels
STEPS = 32767  # limit: steps of a coordinate from 0 to 1: 16 bits
PLANT_SHARE = 0.25  # chosen: radius of a plant without shapes, as a share of the distance of its cameras


@dataclass(frozen=True, eq=False)
class Frame:
    """The page's frame: page = (rotation @ world - middle) / radius.

    Attributes:
        rotation: (3, 3) float64, rows are the page's axes in the world.
        middle: (3,) float64, middle of the plant, turned.
        radius: radius of the plant, world units, > 0.
        is_up_known: whether +y is the scene's up, and not just that of most photos.
    """

    rotation: Floats
    middle: Floats
    radius: float
    is_up_known: bool

    def place(self, points: Floats) -> Floats:
        """World points (P, 3) in the page's frame."""
        return (points @ self.rotation.T - self.middle) / self.radius

    def turn(self, directions: Floats) -> Floats:
        """World directions (P, 3) in the page's frame, their lengths kept."""
        return directions @ self.rotation.T


def describe_space(result: Result) -> dict[str, Any]:
    """Meshes, cameras and a grid on the ground, as the page reads them. Cameras are given by their centre, the corners
    of the photo (top left, top right, bottom right, bottom left) at depth 1, and where their photo is up and where they
    look."""
    meshes = small_meshes(result)
    frame = find_frame(result.scene, meshes)
    placed = {leaf: frame.place(mesh.vertices) for leaf, mesh in meshes.items()}
    nodes = [] if result.traits is None else [node for stem in result.traits.stems for node in stem.nodes]
    low = min((float(points[:, 1].min()) for points in placed.values()), default=-1.0)
    return {
        "leaves": {leaf: _encode(placed[leaf], mesh) for leaf, mesh in meshes.items()},
        "stems": [_describe_part(part, frame) for part in parts_of(result)],
        "nodes": [{"leaf": each.leaf, "at": _rounded(frame.place(np.array([each.place]))[0])} for each in nodes],
        "cameras": describe_cameras(result.scene.cameras, frame),
        "ground": round(low, 4),
        "grid": grid_step(frame.radius),
        "radius": frame.radius,
        "isUpKnown": frame.is_up_known,
        "upFrom": "" if result.traits is None else result.traits.up_from,
    }


def small_meshes(result: Result) -> dict[int, trimesh.Trimesh]:
    """{instance id: mesh of a few hundred triangles}, world frame; of surfaces, and of voxels where there is none."""
    meshes = {}
    for instance in range(1, result.matching.num_instances + 1):
        shape = best_shape(instance, result.surfaces, result.voxels)
        if isinstance(shape, LeafSurface):
            meshes[instance] = shape.mesh(*MESH_SHAPE)
        elif isinstance(shape, VoxelGrid) and len((mesh := shape.mesh()).faces):
            meshes[instance] = simplify_mesh(mesh, VOXEL_FACES)
    return meshes


def find_frame(scene: Scene, meshes: Mapping[int, trimesh.Trimesh]) -> Frame:
    """The frame around some meshes; without any, around the place that the cameras look at."""
    cameras = scene.cameras.to("cpu")
    up = find_upward(cameras) if scene.up is None else np.array(scene.up)
    up = -cameras.R[:, 2].mean(0).numpy() if up is None else up
    length = float(np.linalg.norm(up))
    east, north, upward = level_frame(tuple((up / length).tolist()) if length > 1e-9 else (0.0, 0.0, 1.0))
    rotation = np.stack([east, upward, -north])
    if meshes:
        points = np.concatenate([mesh.vertices for mesh in meshes.values()]) @ rotation.T
        middle = (points.min(0) + points.max(0)) / 2
        radius = float(np.linalg.norm(points - middle, axis=1).max())
    else:
        target = nearest_point(cameras.centers, cameras.R[:, 2]).numpy()  # looked at by all
        middle = rotation @ target
        radius = PLANT_SHARE * float(np.median(np.linalg.norm(cameras.centers.numpy() - target, axis=1)))
    return Frame(rotation=rotation, middle=middle, radius=max(radius, 1e-9), is_up_known=scene.up is not None)


def describe_cameras(cameras: Cameras, frame: Frame) -> list[dict[str, Any]]:
    """One entry per view, in the page's frame."""
    cameras = cameras.to("cpu")
    centers = frame.place(cameras.centers.numpy())
    described = []
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        corners = torch.tensor([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], dtype=torch.float64)
        described.append({
            "center": _rounded(centers[view]),
            "corners": [_rounded(ray) for ray in frame.turn((corners @ cameras.world_from_px[view].T).numpy())],
            "up": _rounded(frame.turn(-cameras.R[view, 1].numpy())),
            "ahead": _rounded(frame.turn(cameras.R[view, 2].numpy())),
        })  # fmt: skip
    return described


def grid_step(radius: float) -> float:
    """Side of the squares of the grid: 1, 2 or 5 times a power of ten, a fifth to a half of the plant's radius."""
    most = radius / 2
    power = 10 ** math.floor(math.log10(most))
    return max(step * power for step in (1, 2, 5) if step * power <= most)


def _describe_part(part: StemPart, frame: Frame) -> dict[str, Any]:
    mesh = part.mesh()
    about = {"color": f"#{bytes(part.color).hex()}", "leaf": part.leaf, "isGuessed": part.is_guessed}
    return about | _encode(frame.place(mesh.vertices), mesh)


def _encode(points: Floats, mesh: trimesh.Trimesh) -> dict[str, str]:
    steps = np.round(np.clip(points, -1, 1) * STEPS).astype("<i2")
    arrays = {"points": steps, "faces": np.asarray(mesh.faces).astype("<u2")}
    return {name: base64.b64encode(each.tobytes()).decode("ascii") for name, each in arrays.items()}


def _rounded(values: Floats) -> list[float]:
    return [round(float(value), 5) + 0.0 for value in values]
