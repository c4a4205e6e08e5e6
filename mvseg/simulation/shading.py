"""The colours of a photo: light on leaves, pot and ground, and the camera's response to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.simulation.look import Floats, Look

MATERIALS = ("leaf", "stem", "pot", "soil", "ground", "stake")
LEAF, SOIL, GROUND = 0, 3, 4  # definition: kinds of surfaces
VEIN_TINT = np.array([0.8, 0.5, 0.6], np.float32)
SICK = np.array([0.20, 0.13, 0.05], np.float32)
YELLOW = np.array([0.33, 0.26, 0.04], np.float32)
BROWN = np.array([0.17, 0.09, 0.035], np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """Points where n rays from the camera meet a surface; world frame, mm.

    Attributes:
        points: (n, 3).
        view: (n, 3) unit direction of the ray, away from the camera.
        material: (n,) index of MATERIALS.
        leaf_id: (n,), 0 = not a leaf.
        dryness: (n,) as in `Leaf.dryness`.
        face_normal: (n, 3) unit normal of the triangle.
        normal: (n, 3) normal, smooth from vertex to vertex, of any length.
        along: (n, 3) unit direction from the base of the leaf to its tip.
        upper, lower: (n, 3) sky light on the side that the normal points to, and on the other.
        uv: (n, 2) as in `Leaf.uv`.
        lit: (n,) share of the sun that is not hidden, 0 to 1.
    """

    points: Floats
    view: Floats
    material: NDArray[np.uint8]
    leaf_id: NDArray[np.uint16]
    dryness: Floats
    face_normal: Floats
    normal: Floats
    along: Floats
    upper: Floats
    lower: Floats
    uv: Floats
    lit: Floats


def shade(look: Look, hits: Hits) -> Floats:
    """Radiance (n, 3) towards the camera."""
    leaf, rest = np.flatnonzero(hits.material == LEAF), np.flatnonzero(hits.material != LEAF)
    leaf_uv = hits.uv[leaf]
    albedo, through, normal = np.zeros_like(hits.points), np.zeros_like(hits.points), hits.face_normal.copy()
    albedo[rest] = part_color(look, hits.material[rest], hits.points[rest])
    albedo[leaf], through[leaf], slope = leaf_color(look, hits.leaf_id[leaf], leaf_uv, dryness=hits.dryness[leaf])
    normal[leaf] = unit(hits.normal[leaf] + slope[:, None] * hits.along[leaf])
    is_upper = (dot(normal, hits.view) < 0)[:, None]
    normal = np.where(is_upper, normal, -normal)
    front, back = np.where(is_upper, hits.upper, hits.lower), np.where(is_upper, hits.lower, hits.upper)

    direct = (0.02 + 0.98 * hits.lit)[:, None] * look.sun
    facing = dot(normal, look.to_sun)[:, None]
    color = albedo * (front + direct * np.maximum(facing, 0))
    color += through * (back + direct * np.maximum(-facing, 0))
    shine = highlight(look, leaf_uv, normal=normal[leaf], view=hits.view[leaf], direct=direct[leaf], sky=front[leaf])
    color[leaf] += shine * (1 - 0.8 * hits.dryness[leaf, None])
    return color


def highlight(look: Look, uv: Floats, *, normal: Floats, view: Floats, direct: Floats, sky: Floats) -> Floats:
    """Radiance (n, 3) of the sun and the sky as the waxy or wet surface of leaves mirrors them."""
    cosine = np.clip(dot(normal, unit(look.to_sun - view)), 0, 1) * (dot(normal, look.to_sun) > 0)
    patchy = 1 + 0.3 * sample_texture(look.texture, uv[:, 0] * 30, uv[:, 1] * 15)
    lobe = look.gloss * patchy * (look.shine + 8) / 50 * cosine**look.shine
    if look.drops:
        wet = sample_texture(look.texture, uv[:, 0] * 150, uv[:, 1] * 70) > 2.5 - 2 * look.drops
        lobe = np.where(wet, 2 * cosine**150, lobe)
    fresnel = 0.02 + 0.6 * (1 + np.clip(dot(normal, view), -1, 0)) ** 5
    return np.maximum(lobe, 0)[:, None] * direct + (look.gloss * fresnel)[:, None] * sky


def leaf_color(
    look: Look, leaf_id: NDArray[np.uint16], uv: Floats, *, dryness: Floats
) -> tuple[Floats, Floats, Floats]:
    """Colour of leaves of some dryness (n,) at (n, 2) positions `uv` on them: albedo (n, 3), colour (n, 3) of the light
    that passes through, and slope (n,) of the surface towards the tip."""
    u, v, number = uv[:, 0], uv[:, 1], leaf_id.astype(np.float32)
    tint = look.leaf_spread * np.sin(number[:, None] * np.array([12.99, 78.23, 37.72], np.float32))
    blotch = sample_texture(look.texture, u * 40 + number * 37, v * 18 + number * 11)
    side = np.abs(v)
    if look.has_parallel_veins:
        phase, along_vein = side * look.num_veins, np.ones_like(v)
    else:
        phase, along_vein = u * look.num_veins - 1.6 * side + 0.15 * blotch, 1 - v**2
    lateral = np.exp(-120 * (phase % 1 - 0.5) ** 2) * along_vein
    vein = (look.vein * np.clip(lateral + np.exp(-((v * 14) ** 2)), 0, 1))[:, None]
    sick = sample_texture(look.texture, u * 90 + number * 53, v * 40) + 3 * side**6 - 4 + look.spots
    sick = np.clip(sick, 0, 1)[:, None]
    if look.skin is None:
        albedo = look.leaf * np.exp(tint + 0.08 * blotch[:, None] + vein * VEIN_TINT)
    else:
        rows, columns = look.skin.shape[:2]
        albedo = sample_texture(look.skin, (v + 1) / 2 * (columns - 1), u * (rows - 1)) * np.exp(tint)
    if look.marking is not None:
        share = look.marking.bias + look.marking.vein * vein[:, 0] / look.vein + look.marking.blotch * blotch
        share = np.clip(share + look.marking.edge * side**4, 0, 1)[:, None]
        albedo += share * (look.marking.color - albedo)
    albedo += sick * (SICK - albedo)
    grain = np.exp(0.15 * blotch[:, None])
    albedo += np.clip(2 * dryness, 0, 1)[:, None] * (YELLOW * grain - albedo)
    albedo += np.clip(2 * dryness - 1, 0, 1)[:, None] * (BROWN * grain**2 - albedo)
    through = look.through * np.exp(tint) * (1 - 0.6 * vein) * (1 - 0.8 * sick) * (1 - 0.9 * dryness[:, None])
    bulge = look.quilting * (np.sin(2 * np.pi * phase) + 0.5 * blotch) * along_vein
    return albedo, through, np.zeros_like(bulge) if look.has_parallel_veins else bulge


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
    texels = np.zeros((2, rows * 4096), np.float32)
    texels[0, : len(x)], texels[1, : len(x)] = x % width, y % height
    across, down = texels.reshape(2, rows, 4096)
    values: Floats = cv2.remap(texture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
    return values.reshape(rows * 4096, *texture.shape[2:])[: len(x)]


def backdrop_color(look: Look, view: Floats) -> Floats:
    """(n, 3) radiance beyond the ground, along unit directions (n, 3)."""
    rows, columns = look.backdrop.shape[:2]
    x = (np.arctan2(view[:, 1], view[:, 0]) / (2 * np.pi) % 1) * columns
    y = (0.5 - np.arcsin(np.clip(view[:, 2], -1, 1)) / np.pi) * rows
    return sample_texture(look.backdrop, x, y)


def develop(radiance: Floats, look: Look, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The photo (H, W, 3) of radiances (H, W, 3): lens blur and vignetting, exposure, sensor noise, tone curve."""
    height, width = radiance.shape[:2]
    image = cv2.GaussianBlur(radiance, (0, 0), look.blur_px)
    y, x = np.linspace(-1, 1, height, dtype=np.float32)[:, None], np.linspace(-1, 1, width, dtype=np.float32)
    image = image * look.exposure * (1 - look.vignette / 2 * (x**2 + y**2))[..., None]
    image += look.noise * np.sqrt(0.02 + image) * rng.standard_normal(image.shape, np.float32)
    image = (1 - np.exp(-1.6 * np.maximum(image, 0))) ** look.contrast
    table = np.linspace(0, 1, 4096)
    table = np.where(table < 0.0031308, 12.92 * table, 1.055 * table ** (1 / 2.4) - 0.055) * 255 + 0.5
    return table.astype(np.uint8)[(image * 4095 + 0.5).astype(np.int32)]


def dot(a: Floats, b: Floats) -> Floats:
    """(n,) dot products of the rows of (n, 3) with the rows of (n, 3) or with one vector (3,)."""
    return np.einsum("ij,ij->i" if b.ndim == 2 else "ij,j->i", a, b)


def unit(vectors: NDArray[Any]) -> Floats:
    """(n, 3) vectors scaled to length 1; zero vectors stay zero."""
    norms = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    return (vectors / np.maximum(norms, 1e-30)).astype(np.float32)
