"""Photo-like images of a plant with exact instance ids and depths, by ray casting on the CPU.

The ray through each pixel centre decides id and depth; they depend on the plant and the camera only. The colours
come from a small shader: sun with shadows, sky light gathered at the vertices, light through the leaves, veins, spots,
wet highlights, soil, pot, ground and backdrop, and at last the camera's blur and noise. Everything that colour depends
on is drawn once per seed as a `Look`, so that all views of one plant share it.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.simulation.growth import Plant
from mvseg.simulation.look import Floats, Look, draw_look

Doubles = NDArray[np.float64]

MATERIALS = ("leaf", "stem", "pot", "soil", "ground", "stake")
LEAF, SOIL, GROUND = 0, 3, 4
LIFT_MM = 0.05  # shadow rays start this far off the surface
SUN_RAYS = 3  # per pixel
SKY_RAYS = 48  # per vertex, over the full sphere
VEIN_TINT = np.array([0.8, 0.5, 0.6], np.float32)
SICK = np.array([0.20, 0.13, 0.05], np.float32)


@dataclass(frozen=True, eq=False)
class Rendering:
    """One view: rgb (H, W, 3) uint8; ids (H, W) uint16, 0 = not a leaf; depth (H, W) float32, along the camera's +z in
    world units, inf where nothing is hit."""

    rgb: NDArray[np.uint8]
    ids: NDArray[np.uint16]
    depth: Floats


@dataclass(frozen=True, eq=False)
class Stage:
    """A plant ready to be photographed: P vertices and F triangles of all its meshes, and the light on them."""

    bvh: EmbreeScene
    faces: NDArray[np.int32]  # (F, 3)
    attributes: Floats  # (P, 11): normal, sky light on the upper and on the lower side, uv
    face_normals: Floats  # (F, 3)
    along: Floats  # (F, 3) unit direction of growing u
    owner: NDArray[np.uint16]  # (F,) leaf id, 0 for parts
    material: NDArray[np.uint8]  # (F,) an index of MATERIALS
    has_parallel_veins: bool
    look: Look


def render_view(
    plant: Plant, K: Doubles, R: Doubles, t: Doubles, width: int, height: int, *, seed: int
) -> Rendering:
    """Photograph a plant.

    Args:
        plant: world units as in `Plant`.
        K: (3, 3) px_from_cam; the centre of the top-left pixel is (0.5, 0.5).
        R: (3, 3) and t: (3,): cam_from_world, camera +x right, +y down, +z forward.
        width: pixels.
        height: pixels.
        seed: of light, materials and camera noise; ids and depth do not depend on it.

    Raises:
        InputError: an image size below 1.
    """
    return render_stage(build_stage(plant, seed=seed), K, R, t, width, height)


def render_stage(stage: Stage, K: Doubles, R: Doubles, t: Doubles, width: int, height: int) -> Rendering:
    """As `render_view`, for a stage that serves many views."""
    if min(width, height) < 1:
        raise InputError(f"the image size is {width} x {height}, expected at least 1 x 1")
    rows, columns = np.mgrid[:height, :width]
    centres = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    # the noise differs from view to view and from look to look, but not from run to run
    drawn_from = [np.asarray(x, np.float64).tobytes() for x in (K, R, t, stage.look.exposure)]
    rng = np.random.default_rng(zlib.crc32(b"".join(drawn_from)))
    color, face, depth = trace(stage, centres, K, R, t, rng)
    hit = face >= 0
    ids = np.where(hit, stage.owner[face], 0).astype(np.uint16).reshape(height, width)
    kinds = np.where(hit, stage.material[face], len(MATERIALS)).reshape(height, width)

    borders = np.flatnonzero(border_pixels(ids.astype(np.int32) * (len(MATERIALS) + 1) + kinds))
    quarters = [(dx, dy) for dx in (-0.25, 0.25) for dy in (-0.25, 0.25)]
    color[borders] = sum(trace(stage, centres[borders] + shift, K, R, t, rng)[0] for shift in quarters) / 4
    rgb = develop(color.reshape(height, width, 3), stage.look, rng)
    return Rendering(rgb, ids, depth.reshape(height, width))


def border_pixels(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(H, W) pixels with another label among their four neighbours."""
    border = np.zeros(labels.shape, bool)
    below, right = labels[1:] != labels[:-1], labels[:, 1:] != labels[:, :-1]
    border[1:] |= below
    border[:-1] |= below
    border[:, 1:] |= right
    border[:, :-1] |= right
    return border


def trace(
    stage: Stage, px: Doubles, K: Doubles, R: Doubles, t: Doubles, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int32], Floats]:
    """Radiance (n, 3), face (n,) (-1 for none) and depth (n,) seen through the pixel positions (n, 2)."""
    x, y, z = (R.T @ np.linalg.inv(K)).T  # the columns of world_from_px
    rays = (px[:, :1] * x + px[:, 1:] * y + z).astype(np.float32)  # depth 1 along +z; no BLAS, whose sums may vary
    origins = np.tile((-R.T @ t).astype(np.float32), (len(rays), 1))
    found = stage.bvh.run(origins, rays, output=True)
    face = found["primID"]
    depth = np.where(face >= 0, found["tfar"], np.inf).astype(np.float32)
    view = unit(rays)
    color = backdrop_color(stage.look, view)
    hit = np.flatnonzero(face >= 0)
    u, v = found["u"][hit, None], found["v"][hit, None]
    corners = stage.faces[face[hit]]
    values = stage.attributes[corners[:, 0]] * (1 - u - v)
    values += stage.attributes[corners[:, 1]] * u
    values += stage.attributes[corners[:, 2]] * v
    color[hit] = shade(stage, face[hit], values, origins[hit] + depth[hit, None] * rays[hit], view[hit], rng)
    return color, face, depth


# --- light and shade


def dot(a: Floats, b: Floats) -> Floats:
    """(n,) products of the rows of (n, 3) with the rows of (n, 3) or with one vector (3,)."""
    return np.einsum("ij,ij->i" if b.ndim == 2 else "ij,j->i", a, b)


def shade(
    stage: Stage, face: NDArray[np.int32], values: Floats, points: Floats, view: Floats, rng: np.random.Generator
) -> Floats:
    """Radiance (n, 3) towards the camera of points on faces; `view` leaves the camera."""
    look = stage.look
    leaf = np.flatnonzero(stage.material[face] == LEAF)
    albedo, through, normal = np.zeros_like(points), np.zeros_like(points), stage.face_normals[face]
    geometric = normal.copy()
    rest = np.flatnonzero(stage.material[face] != LEAF)
    albedo[rest] = part_color(look, stage.material[face[rest]], points[rest])
    albedo[leaf], through[leaf], slope = leaf_color(stage, stage.owner[face[leaf]], values[leaf, 9:])
    normal[leaf] = unit(values[leaf, :3] + slope[:, None] * stage.along[face[leaf]])
    is_upper = (dot(normal, view) < 0)[:, None]
    normal = np.where(is_upper, normal, -normal)
    front, back = np.where(is_upper, values[:, 3:6], values[:, 6:9]), np.where(is_upper, values[:, 6:9], values[:, 3:6])

    start = points + LIFT_MM * np.sign(dot(geometric, look.to_sun))[:, None] * geometric
    lit = np.zeros(len(points), np.float32)
    for _ in range(SUN_RAYS):
        rays = look.to_sun + look.sun_blur * rng.standard_normal(points.shape, np.float32)
        lit += (stage.bvh.run(start, rays, query="OCCLUDED") < 0) / np.float32(SUN_RAYS)
    direct = (0.02 + 0.98 * lit)[:, None] * look.sun
    facing = dot(normal, look.to_sun)[:, None]
    color = albedo * (front + direct * np.maximum(facing, 0))
    color += through * (back + direct * np.maximum(-facing, 0))
    color[leaf] += highlight(look, values[leaf, 9:], normal[leaf], view[leaf], direct[leaf], front[leaf])
    return color


def highlight(look: Look, uv: Floats, normal: Floats, view: Floats, direct: Floats, sky: Floats) -> Floats:
    """Radiance (n, 3) of the sun and the sky that the waxy or wet surface of leaves mirrors."""
    cosine = np.clip(dot(normal, unit(look.to_sun - view)), 0, 1) * (dot(normal, look.to_sun) > 0)
    patchy = 1 + 0.3 * sample_texture(look.texture, uv[:, 0] * 30, uv[:, 1] * 15)
    lobe = look.gloss * patchy * (look.shine + 8) / 50 * cosine**look.shine
    if look.drops:
        wet = sample_texture(look.texture, uv[:, 0] * 150, uv[:, 1] * 70) > 2.5 - 2 * look.drops
        lobe = np.where(wet, 2 * cosine**150, lobe)
    fresnel = 0.02 + 0.6 * (1 + np.clip(dot(normal, view), -1, 0)) ** 5
    return np.maximum(lobe, 0)[:, None] * direct + (look.gloss * fresnel)[:, None] * sky


def leaf_color(stage: Stage, leaf_id: NDArray[np.uint16], uv: Floats) -> tuple[Floats, Floats, Floats]:
    """Albedo (n, 3), colour of the light let through (n, 3), slope of the surface towards the tip (n,)."""
    look, u, v, number = stage.look, uv[:, 0], uv[:, 1], leaf_id.astype(np.float32)
    own = look.leaf_spread * np.sin(number[:, None] * np.array([12.99, 78.23, 37.72], np.float32))
    blotch = sample_texture(look.texture, u * 40 + number * 37, v * 18 + number * 11)
    side = np.abs(v)
    if stage.has_parallel_veins:
        phase, along_vein = side * look.num_veins, np.ones_like(v)
    else:
        phase, along_vein = u * look.num_veins - 1.6 * side + 0.15 * blotch, 1 - v**2
    lateral = np.exp(-120 * (phase % 1 - 0.5) ** 2) * along_vein
    vein = (look.vein * np.clip(lateral + np.exp(-((v * 14) ** 2)), 0, 1))[:, None]
    sick = sample_texture(look.texture, u * 90 + number * 53, v * 40) + 3 * side**6 - 4 + look.spots
    sick = np.clip(sick, 0, 1)[:, None]
    albedo = look.leaf * np.exp(own + 0.08 * blotch[:, None] + vein * VEIN_TINT)
    albedo += sick * (SICK - albedo)
    through = look.through * np.exp(own) * (1 - 0.6 * vein) * (1 - 0.8 * sick)
    bulge = look.quilting * (np.sin(2 * np.pi * phase) + 0.5 * blotch) * along_vein
    return albedo, through, np.zeros_like(bulge) if stage.has_parallel_veins else bulge


def part_color(look: Look, material: NDArray[np.uint8], points: Floats) -> Floats:
    """Albedo (n, 3) of stems, pot, soil and ground."""
    x, y, z = points.T
    fade = 1 / (1 + (x**2 + y**2) / 500**2)  # far away the noise is finer than the pixels
    fine = sample_texture(look.texture, x * 1.7 + z, y * 1.7 + z) * fade
    fine += 0.6 * sample_texture(look.texture, x * 0.23 + y * 0.11, y * 0.23 - x * 0.11)
    size, stretch, joints = look.ground_grain
    broad = sample_texture(look.texture, x * 40 / size, y * 40 / (size * stretch)) * fade
    broad += sample_texture(look.texture, x * 4 / size + y / size, y * 4 / size)
    is_ground = material == GROUND
    albedo = look.plain[material - 1] * np.exp(look.grain[material - 1] * np.where(is_ground, broad, fine))[:, None]
    if joints:
        gap = np.minimum(x % joints, y % (2 * joints)) < 0.015 * joints
        albedo[gap & is_ground] *= 0.5
    albedo[(material == SOIL) & (fine > 2.6)] = 0.5  # perlite
    return albedo


def sample_texture(texture: Floats, x: Floats, y: Floats) -> Floats:
    """(n,) or (n, channels) values of a periodic texture at positions in texels, bilinear."""
    height, width = texture.shape[:2]
    rows = len(x) // 4096 + 1  # OpenCV's remap takes at most 32767 columns
    places = np.zeros((2, rows * 4096), np.float32)
    places[0, : len(x)], places[1, : len(x)] = x % width, y % height
    across, down = places.reshape(2, rows, 4096)
    values: Floats = cv2.remap(texture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
    return values.reshape(rows * 4096, *texture.shape[2:])[: len(x)]


def backdrop_color(look: Look, view: Floats) -> Floats:
    """(n, 3) what is seen beyond the ground."""
    rows, columns = look.backdrop.shape[:2]
    x = (np.arctan2(view[:, 1], view[:, 0]) / (2 * np.pi) % 1) * columns
    y = (0.5 - np.arcsin(np.clip(view[:, 2], -1, 1)) / np.pi) * rows
    return sample_texture(look.backdrop, x, y)


def develop(radiance: Floats, look: Look, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The photo (H, W, 3) of a picture of radiances: lens blur and fall-off, exposure, sensor noise, tone curve."""
    height, width = radiance.shape[:2]
    image = cv2.GaussianBlur(radiance, (0, 0), look.blur_px)
    y, x = np.linspace(-1, 1, height, dtype=np.float32)[:, None], np.linspace(-1, 1, width, dtype=np.float32)
    image = image * look.exposure * (1 - look.vignette / 2 * (x**2 + y**2))[..., None]
    image += look.noise * np.sqrt(0.02 + image) * rng.standard_normal(image.shape, np.float32)
    image = (1 - np.exp(-1.6 * np.maximum(image, 0))) ** look.contrast
    table = np.linspace(0, 1, 4096)
    table = np.where(table < 0.0031308, 12.92 * table, 1.055 * table ** (1 / 2.4) - 0.055) * 255 + 0.5
    return table.astype(np.uint8)[(image * 4095 + 0.5).astype(np.int32)]


# --- what is drawn once per scene


def build_stage(plant: Plant, *, seed: int) -> Stage:
    """The plant with a `Look` drawn from the seed, ready for `render_stage`."""
    meshes = [(leaf.vertices, leaf.faces, LEAF, leaf.leaf_id) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces, MATERIALS.index(part.material), 0) for part in plant.parts]
    counts = [len(mesh[1]) for mesh in meshes]
    starts = np.cumsum([0] + [len(mesh[0]) for mesh in meshes])
    vertices = np.concatenate([mesh[0] for mesh in meshes])
    faces = np.concatenate([mesh[1] + start for mesh, start in zip(meshes, starts[:-1], strict=True)]).astype(np.int32)
    uv = np.zeros((len(vertices), 2))
    uv[: starts[len(plant.leaves)]] = np.concatenate([np.zeros((0, 2)), *(leaf.uv for leaf in plant.leaves)])

    first, second = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    across = np.cross(first, second)
    du = uv[faces[:, 1:], 0] - uv[faces[:, :1], 0]
    along = np.cross(du[:, :1] * second - du[:, 1:] * first, across)  # gradient of u, up to a positive factor
    normals = unit(np.stack([np.bincount(faces.ravel(), np.repeat(n, 3), len(vertices)) for n in across.T], 1))
    bvh = EmbreeScene(robust=True)
    vertices32 = vertices.astype(np.float32)
    TriangleMesh(bvh, vertices32, faces)
    look = draw_look(np.random.default_rng(seed))
    upper, lower = gather_skylight(bvh, vertices32, normals, look)
    return Stage(
        bvh=bvh,
        faces=faces,
        attributes=np.concatenate([normals, upper, lower, uv.astype(np.float32)], 1),
        face_normals=unit(across),
        along=unit(along),
        owner=np.repeat(np.array([mesh[3] for mesh in meshes], np.uint16), counts),
        material=np.repeat(np.array([mesh[2] for mesh in meshes], np.uint8), counts),
        has_parallel_veins=plant.family == "strap",
        look=look,
    )


def unit(vectors: NDArray[Any]) -> Floats:
    """(n, 3) vectors scaled to length 1; zero vectors stay zero."""
    norms = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    return (vectors / np.maximum(norms, 1e-30)).astype(np.float32)


def gather_skylight(bvh: EmbreeScene, vertices: Floats, normals: Floats, look: Look) -> Floats:
    """(2, P, 3) irradiance / pi from the sky on the side of each vertex that its normal looks to, and on the other.

    The same directions serve every vertex, so that the light is smooth over the surface.
    """
    z = 1 - (2 * np.arange(SKY_RAYS) + 1) / SKY_RAYS
    angle = np.arange(SKY_RAYS) * np.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), z], 1).astype(np.float32)
    blocked = 0.12 * look.zenith + 0.06 * look.sun  # what leaves and soil send on
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
