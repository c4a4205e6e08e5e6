"""Photo-like images of a plant with exact instance ids and depths, by ray casting on the CPU.

The ray through each pixel centre decides id and depth; they depend on the plant and the camera only. Further rays tell
how much sun and sky reach a surface, and `shading` makes colours of that. A `Look`, drawn once per seed, holds
everything that colour depends on, so that all views of one plant share it.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from skimage.segmentation import find_boundaries

from mvseg.scene import Cameras
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.look import Floats, Look, draw_look, draw_wild_look
from mvseg.simulation.shading import GROUND, LEAF, MATERIALS, Hits, backdrop_color, develop, dot, shade, unit

Doubles = NDArray[np.float64]

LIFT_MM = 0.05  # limit: shadow rays start this far off the surface
SUN_RAYS = 3  # limit: per pixel
SKY_RAYS = 48  # limit: per vertex, over the full sphere


@dataclass(frozen=True, eq=False)
class Rendering:
    """One view.

    Attributes:
        rgb: (H, W, 3) uint8.
        ids: (H, W) uint16, 0 = not a leaf.
        depth: (H, W) float32, along the camera's +z in world units; infinite where nothing is hit.
    """

    rgb: NDArray[np.uint8]
    ids: NDArray[np.uint16]
    depth: Floats


@dataclass(frozen=True, eq=False)
class Mesh:
    """All meshes of a plant as one, of P vertices and F triangles."""

    vertices: Doubles  # (P, 3)
    faces: NDArray[np.int32]  # (F, 3)
    uv: Doubles  # (P, 2) as in `Leaf.uv`; 0 for parts
    owner: NDArray[np.uint16]  # (F,) leaf id, 0 for parts
    material: NDArray[np.uint8]  # (F,) an index of MATERIALS
    dryness: Floats  # (F,) as in `Leaf.dryness`, 0 for parts


@dataclass(frozen=True, eq=False)
class Stage:
    """A plant ready to be photographed, and the light on it."""

    mesh: Mesh
    bvh: EmbreeScene
    attributes: Floats  # (P, 11): normal, sky light on the upper and on the lower side, uv
    face_normals: Floats  # (F, 3)
    along: Floats  # (F, 3) unit direction of growing u
    look: Look


# --- views


def render_stage(stage: Stage, cameras: Cameras, view: int) -> Rendering:
    """Photograph a plant with one of V cameras, in its world units; ids and depth do not depend on the stage's seed."""
    K, R, t = (part[view].numpy() for part in (cameras.K, cameras.R, cameras.t))
    width, height = cameras.sizes[view].tolist()
    center, world_from_px = (-R.T @ t).astype(np.float32), R.T @ np.linalg.inv(K)
    # the noise differs from view to view and from look to look, but not from run to run
    drawn_from = [np.asarray(part, np.float64).tobytes() for part in (K, R, t, stage.look.exposure)]
    rng = np.random.default_rng(zlib.crc32(b"".join(drawn_from)))
    rows, columns = np.mgrid[:height, :width]
    centres = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5

    def look(px: Doubles) -> tuple[Floats, NDArray[np.int32], Floats]:
        x, y, z = world_from_px.T
        rays = (px[:, :1] * x + px[:, 1:] * y + z).astype(np.float32)  # depth 1 along +z; no BLAS, whose sums may vary
        return trace_rays(stage, np.tile(center, (len(rays), 1)), rays, rng=rng)

    color, face, depth = look(centres)
    hit = face >= 0
    ids = np.where(hit, stage.mesh.owner[face], 0).astype(np.uint16).reshape(height, width)
    kinds = np.where(hit, stage.mesh.material[face], len(MATERIALS)).reshape(height, width)

    borders = np.flatnonzero(find_boundaries(ids.astype(np.int32) * (len(MATERIALS) + 1) + kinds))
    quarters = [(dx, dy) for dx in (-0.25, 0.25) for dy in (-0.25, 0.25)]
    color[borders] = sum(look(centres[borders] + shift)[0] for shift in quarters) / 4
    return Rendering(develop(color.reshape(height, width, 3), stage.look, rng), ids, depth.reshape(height, width))


def trace_rays(
    stage: Stage, origins: Floats, rays: Floats, *, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int32], Floats]:
    """Radiance (n, 3), face (n,) (-1 for none) and depth (n,) seen along rays (n, 3), whose length is a depth of 1."""
    first_hit = stage.bvh.run(origins, rays, output=True)
    face = first_hit["primID"]
    depth = np.where(face >= 0, first_hit["tfar"], np.inf).astype(np.float32)
    view = unit(rays)
    color = backdrop_color(stage.look, view)
    hit = np.flatnonzero(face >= 0)
    u, v, face_hit = first_hit["u"][hit, None], first_hit["v"][hit, None], face[hit]
    one, two, three = (stage.attributes[corner] for corner in stage.mesh.faces[face_hit].T)
    values = one * (1 - u - v) + two * u + three * v
    points, face_normal = origins[hit] + depth[hit, None] * rays[hit], stage.face_normals[face_hit]
    mesh = stage.mesh
    hits = Hits(
        points=points, view=view[hit], face_normal=face_normal, along=stage.along[face_hit],
        material=mesh.material[face_hit], leaf_id=mesh.owner[face_hit], dryness=mesh.dryness[face_hit],
        normal=values[:, :3], upper=values[:, 3:6], lower=values[:, 6:9], uv=values[:, 9:],
        lit=gather_sunlight(stage, points, face_normal, rng=rng),
    )  # fmt: skip
    color[hit] = shade(stage.look, hits)
    return color, face, depth


def gather_sunlight(stage: Stage, points: Floats, face_normal: Floats, *, rng: np.random.Generator) -> Floats:
    """(n,) share of the sun that is seen from points (n, 3) on faces."""
    look = stage.look
    start = points + LIFT_MM * np.sign(dot(face_normal, look.to_sun))[:, None] * face_normal
    lit = np.zeros(len(points), np.float32)
    for _ in range(SUN_RAYS):
        rays = look.to_sun + look.sun_blur * rng.standard_normal(points.shape, np.float32)
        lit += (stage.bvh.run(start, rays, query="OCCLUDED") < 0) / np.float32(SUN_RAYS)
    return lit


# --- what all views share


def build_stage(plant: SimulatedPlant, *, seed: int) -> Stage:
    """The plant with a `Look` drawn from the seed, ready for `render_stage`."""
    mesh = merge_meshes(plant)
    vertices, faces = mesh.vertices, mesh.faces
    first, second = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    across = np.cross(first, second)
    du = mesh.uv[faces[:, 1:], 0] - mesh.uv[faces[:, :1], 0]
    along = np.cross(du[:, :1] * second - du[:, 1:] * first, across)  # gradient of u, up to a positive factor
    normals = unit(np.stack([np.bincount(faces.ravel(), np.repeat(n, 3), len(vertices)) for n in across.T], 1))
    bvh = build_bvh(mesh)
    look = draw_look(np.random.default_rng(seed), has_parallel_veins=FAMILIES[plant.family].has_parallel_veins)
    if plant.is_wild:
        look = draw_wild_look(look, np.random.default_rng([seed, 1]))
    upper, lower = gather_skylight(bvh, look, vertices=vertices.astype(np.float32), normals=normals)
    attributes = np.concatenate([normals, upper, lower, mesh.uv.astype(np.float32)], 1)
    return Stage(mesh=mesh, bvh=bvh, attributes=attributes, face_normals=unit(across), along=unit(along), look=look)


def merge_meshes(plant: SimulatedPlant) -> Mesh:
    """The leaves, and after them the parts, as one mesh."""
    meshes = [(leaf.vertices, leaf.faces, LEAF, leaf.leaf_id, leaf.dryness) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces, MATERIALS.index(part.material), 0, 0.0) for part in plant.parts]
    counts = [len(mesh[1]) for mesh in meshes]
    starts = np.cumsum([0] + [len(mesh[0]) for mesh in meshes])
    faces = np.concatenate([mesh[1] + start for mesh, start in zip(meshes, starts[:-1], strict=True)]).astype(np.int32)
    uv = np.zeros((starts[-1], 2))
    uv[: starts[len(plant.leaves)]] = np.concatenate([np.zeros((0, 2)), *(leaf.uv for leaf in plant.leaves)])

    def per_face(column: int, dtype: type) -> NDArray[Any]:
        return np.repeat(np.array([mesh[column] for mesh in meshes], dtype), counts)

    vertices = np.concatenate([mesh[0] for mesh in meshes])
    material, owner, dryness = per_face(2, np.uint8), per_face(3, np.uint16), per_face(4, np.float32)
    return Mesh(vertices=vertices, faces=faces, uv=uv, owner=owner, material=material, dryness=dryness)


def build_bvh(mesh: Mesh) -> EmbreeScene:
    """The mesh as Embree searches it, in float32."""
    bvh = EmbreeScene(robust=True)
    TriangleMesh(bvh, mesh.vertices.astype(np.float32), mesh.faces)
    return bvh


def gather_skylight(bvh: EmbreeScene, look: Look, *, vertices: Floats, normals: Floats) -> Floats:
    """(2, P, 3) irradiance / pi from the sky on the side of each vertex that its normal points to, and on the other.
    The same directions serve every vertex, so that the light is smooth over the surface."""
    z = 1 - (2 * np.arange(SKY_RAYS) + 1) / SKY_RAYS
    angle = np.arange(SKY_RAYS) * np.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), z], 1).astype(np.float32)
    blocked = 0.12 * look.zenith + 0.06 * look.sun  # what leaves and soil reflect
    below = 0.3 * look.plain[GROUND - 1] * (look.zenith + look.sun * look.to_sun[2])
    gathered = np.zeros((2, len(vertices), 3), np.float32)
    for direction in directions:
        cosine = dot(normals, direction)
        start = vertices + 4 * LIFT_MM * np.sign(cosine)[:, None] * normals
        is_open = bvh.run(start, np.tile(direction, (len(start), 1)), query="OCCLUDED") < 0
        height = float(direction[2])
        light = look.horizon + (look.zenith - look.horizon) * math.sqrt(height) if height > 0 else below
        seen = np.where(is_open[:, None], light, blocked) * np.float32(4 / SKY_RAYS)
        gathered[0] += np.maximum(cosine, 0)[:, None] * seen
        gathered[1] += np.maximum(-cosine, 0)[:, None] * seen
    return gathered
