"""Light, materials and camera of a photo, drawn once per scene."""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

TEXTURE_SIZE = 256  # limit: pixels of a texture's side


@dataclass(frozen=True, eq=False)
class Marking:
    """A second colour, linear RGB (3,), on every leaf of a plant.

    Attributes:
        vein, blotch, edge: how much veins, patches of noise and the margin of the leaf raise the share of that colour.
        bias: share without any of them, before it is cut to [0, 1].
    """

    color: Floats
    vein: float
    blotch: float
    edge: float
    bias: float


@dataclass(frozen=True, eq=False)
class Look:
    """Light, materials and camera of one scene. Colours are linear RGB, (3,) float32."""

    to_sun: Floats  # (3,) unit
    sun: Floats
    sun_blur: float  # angular radius, radians
    zenith: Floats
    horizon: Floats
    leaf: Floats
    leaf_spread: float  # from leaf to leaf
    through: Floats  # colour of the light that passes through a blade
    vein: float
    num_veins: float
    has_parallel_veins: bool
    quilting: float  # slope of the bulges between the veins
    spots: float
    gloss: float
    shine: float  # exponent of the highlight
    drops: float  # share of the blade that is wet
    plain: Floats  # (5, 3) colours of STEM, POT, SOIL, GROUND, STAKE
    grain: Floats  # (5,) contrast of their noise
    ground_grain: tuple[float, float, float]  # size of the noise in mm, its stretch, distance of joints in mm (0: none)
    backdrop: Floats  # (h, w, 3): azimuth to the right, elevation from 90 (top) to -90 degrees
    texture: Floats  # (s, s) periodic noise of unit variance
    exposure: Floats
    contrast: float
    blur_px: float
    noise: float
    vignette: float
    skin: Floats | None = None  # (h, w, 3) over `Leaf.uv`, in place of `leaf`
    marking: Marking | None = None


def draw_look(rng: np.random.Generator, *, has_parallel_veins: bool = False) -> Look:
    """Random light, materials and camera."""
    height, azimuth = math.radians(rng.uniform(30, 80)), rng.uniform(0, 2 * np.pi)
    to_sun = [math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)]
    overcast, warmth = rng.uniform(0, 1) ** 1.5, rng.uniform(-0.1, 0.15)
    sun = (1.7 - 1.4 * overcast) * np.array([1 + warmth, 1, 1 - warmth])
    zenith = (0.3 + 0.5 * overcast) * np.array([1 - 0.7 * warmth, 1, 1 + 0.7 * warmth])
    leaf = hue_color(rng.uniform(0.21, 0.31), rng.uniform(0.65, 0.92), 0.09 * 3.2 ** rng.uniform(0, 1))
    stem = hue_color(rng.uniform(0.05, 0.28), rng.uniform(0.4, 0.8), rng.uniform(0.1, 0.3))
    pot = hue_color(rng.uniform(0, 1), rng.uniform(0, 0.8), rng.choice([0.03, 0.15, 0.4, 0.75]))
    soil = hue_color(rng.uniform(0.04, 0.10), rng.uniform(0.3, 0.65), rng.uniform(0.03, 0.10))
    ground = hue_color(rng.uniform(0, 1), 0.8 * rng.uniform(0, 1) ** 2, rng.choice([0.04, 0.15, 0.35, 0.6]))
    stake = hue_color(rng.uniform(0.05, 0.15), rng.uniform(0, 0.6), rng.uniform(0.2, 0.7))
    balance = 1 + rng.uniform(-0.06, 0.06, 3)
    return Look(
        to_sun=np.array(to_sun, np.float32),
        sun=sun.astype(np.float32),
        sun_blur=rng.uniform(0.003, 0.014),
        zenith=zenith.astype(np.float32),
        horizon=(zenith * rng.uniform(0.5, 1.2)).astype(np.float32),
        leaf=leaf,
        leaf_spread=rng.uniform(0.03, 0.15),
        through=leaf * rng.uniform(0.4, 0.9) * np.array([1.2, 1.2, 0.3], np.float32),
        vein=rng.uniform(0.1, 0.6),
        num_veins=rng.uniform(6, 10),
        has_parallel_veins=has_parallel_veins,
        quilting=rng.uniform(0, 0.14),
        spots=1.8 * rng.uniform(0, 1) ** 3,
        gloss=rng.uniform(0.1, 0.6),
        shine=rng.uniform(8, 40),
        drops=rng.choice([0.0, 0.0, 0.0, 0.5]),
        plain=np.stack([stem, pot, soil, ground, stake]),
        grain=np.array([0.08, 0.04, rng.uniform(0.25, 0.5), rng.uniform(0.01, 0.2), 0.2], np.float32),
        ground_grain=(rng.uniform(20, 200), rng.choice([1.0, 1.0, 10.0]), rng.choice([0.0, 0.0, 90.0, 300.0])),
        backdrop=draw_backdrop(rng, (zenith * rng.uniform(0.05, 1.3)).astype(np.float32)),
        texture=fractal_noise(rng, (TEXTURE_SIZE, TEXTURE_SIZE), rng.uniform(0.7, 1.1)),
        exposure=(balance * rng.uniform(0.75, 1.3) / (0.6 * sun[1] * to_sun[2] + zenith[1])).astype(np.float32),
        contrast=rng.uniform(0.9, 1.3),
        blur_px=rng.uniform(0.35, 0.8),
        noise=rng.uniform(0.004, 0.025),
        vignette=rng.uniform(0, 0.35),
    )


def draw_wild_look(look: Look, rng: np.random.Generator) -> Look:
    """The look with some features of photos from homes and gardens: stems as green as leaves, green pots and mats, waxy
    or wet leaves, overexposure, and black studios, windows or other plants behind."""
    plain, backdrop = look.plain.copy(), look.backdrop
    stem, pot, ground = 0, 1, 3
    if rng.random() < 0.4:
        plain[stem] = look.leaf * rng.uniform(0.6, 1.6)
    if rng.random() < 0.25:
        plain[pot] = hue_color(rng.uniform(0.2, 0.45), rng.uniform(0.3, 0.9), rng.choice([0.05, 0.15, 0.4]))
    if rng.random() < 0.15:
        plain[ground] = hue_color(rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.8), rng.choice([0.05, 0.15, 0.4]))
    behind = rng.choice(["as it is", "studio", "window", "plants"])
    if behind == "studio":
        backdrop, plain[ground] = backdrop * np.float32(0.02), plain[ground] * np.float32(0.1)
    elif behind == "window":
        backdrop = add_windows(backdrop, rng)
    elif behind == "plants":
        backdrop = add_plants(backdrop, rng, color=look.leaf)
    return replace(
        look,
        plain=plain,
        backdrop=backdrop,
        gloss=look.gloss * (rng.uniform(1.5, 3) if rng.random() < 0.2 else 1),
        drops=rng.uniform(0.4, 1.0) if rng.random() < 0.2 else look.drops,
        sun_blur=0.001 if rng.random() < 0.2 else look.sun_blur,
        exposure=look.exposure * np.float32(rng.uniform(1.3, 2.2) if rng.random() < 0.25 else 1),
    )


def add_windows(backdrop: Floats, rng: np.random.Generator) -> Floats:
    """The backdrop (h, w, 3) with one to three windows, much brighter than the room, and their bars."""
    image = backdrop.copy()
    for _ in range(rng.integers(1, 4)):
        x, y, w, h = rng.integers(0, 256), rng.integers(20, 55), rng.integers(10, 45), rng.integers(15, 45)
        panes = np.full((h, w, 3), image.mean() * rng.uniform(3, 10), np.float32)
        panes[:, :: max(4, w // 2)], panes[:: max(4, h // 2)] = image.mean(), image.mean()
        image[y : y + h, np.arange(x, x + w) % 256] = panes
    return image


def add_plants(backdrop: Floats, rng: np.random.Generator, *, color: Floats) -> Floats:
    """The backdrop (h, w, 3) with other plants out of focus: leaves of about the colour given, some of them lit."""
    image, light = backdrop.copy(), 6 * backdrop.mean()
    for _ in range(rng.integers(40, 300)):
        middle = (int(rng.integers(0, 256)), int(rng.normal(66, 14)))
        axes = (int(rng.integers(2, 9)), int(rng.integers(1, 4)))
        shade = light * rng.uniform(0.2, 1.5) * color * np.exp(rng.normal(0, 0.15, 3))
        cv2.ellipse(image, middle, axes, float(rng.uniform(0, 180)), 0, 360, tuple(map(float, shade)), -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.5)).astype(np.float32)


def hue_color(hue: float, saturation: float, value: float) -> Floats:
    """Linear RGB (3,) of hue, saturation and value, each in [0, 1]."""
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value), np.float32)


def fractal_noise(rng: np.random.Generator, shape: tuple[int, int], steepness: float) -> Floats:
    """Periodic noise of mean 0 and variance 1 whose amplitude falls with frequency to the power of `steepness`."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None] * shape[0], np.fft.fftfreq(shape[1])[None] * shape[1]
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) / frequency**steepness).real
    return ((noise - noise.mean()) / noise.std()).astype(np.float32)


def draw_backdrop(rng: np.random.Generator, light: Floats) -> Floats:
    """(128, 256, 3) a blurred room or garden around the plant: panels of random colours over a gradient."""
    image = np.ones((128, 256, 3), np.float32) * light * np.linspace(1.2, 0.7, 128, dtype=np.float32)[:, None, None]
    for _ in range(rng.integers(0, 25)):
        x, y, w, h = rng.integers(0, 256), rng.integers(10, 80), rng.integers(4, 60), rng.integers(6, 60)
        patch = hue_color(rng.uniform(0, 1), rng.uniform(0, 0.7), 1.0) * light * rng.uniform(0.1, 1.5)
        image[y : y + h, np.arange(x, x + w) % 256] = patch
    image *= np.exp(0.2 * fractal_noise(rng, (128, 256), 1.2))[..., None]
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 2.5)).astype(np.float32)
