"""Looks of other species: skins of real leaves, markings along veins or in patches, and colours other than green."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.simulation.look import Floats, Look, Marking, hue_color

ROWS, COLUMNS = 192, 65  # texels of a skin along and across the leaf
GAMMA = 2.2  # of the photos that skins are cut from


def list_skins(folder: Path | None) -> tuple[Floats, ...]:
    """The skins of a folder of cut-out leaves, in the order of their names; none without a folder."""
    if folder is None:
        return ()
    images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(folder.glob("*.png"))]
    leaves = [image for image in images if image is not None and image.shape[2:] == (4,) and image.dtype == np.uint8]
    if not images or len(leaves) < len(images):
        raise SystemExit(f"{folder}: expected PNG files of 8 bits with an alpha channel, each a leaf that was cut out")
    return tuple(unroll_leaf(leaf[..., 2::-1].astype(np.uint8), leaf[..., 3] > 127) for leaf in leaves)


def unroll_leaf(rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> Floats:
    """Texture over `Leaf.uv`, (ROWS, COLUMNS, 3) linear RGB, of a cut-out leaf, `rgb` (H, W, 3) with `mask` (H, W).
    Its long axis becomes the first axis, either end first, and each row across it is stretched to the full width."""
    y, x = np.nonzero(mask)
    points = np.stack([x, y], 1) + 0.5
    center = points.mean(0)
    _, axes = np.linalg.eigh(np.cov((points - center).T))
    across, along = axes[:, 0], axes[:, 1]
    linear = np.asarray((rgb / np.float32(255)) ** np.float32(GAMMA), np.float32)
    # colours bleed over the outline, so that texels at the margin are leaf
    weight = mask.astype(np.float32)
    near = cv2.GaussianBlur(weight, (0, 0), 4)[..., None]
    blurred = cv2.GaussianBlur(linear * weight[..., None], (0, 0), 4) / (near + 1e-6)
    filled = np.where(mask[..., None], linear, blurred).astype(np.float32)

    position = (points - center) @ along
    low, high = position.min(), position.max()
    row = np.minimum((ROWS * (position - low) / (high - low + 1e-9)).astype(int), ROWS - 1)
    offset = (points - center) @ across
    left, right = np.full(ROWS, np.inf), np.full(ROWS, -np.inf)
    np.minimum.at(left, row, offset)
    np.maximum.at(right, row, offset)
    known = np.flatnonzero(np.isfinite(left))
    left, right = (np.interp(np.arange(ROWS), known, side[known]) for side in (left, right))

    s = low + (np.arange(ROWS) + 0.5) / ROWS * (high - low)
    v = np.linspace(0.03, 0.97, COLUMNS)
    t = left[:, None] + v * (right - left)[:, None]
    texels = center + s[:, None, None] * along + t[..., None] * across - 0.5
    x, y = np.moveaxis(texels.astype(np.float32), -1, 0)
    return np.asarray(cv2.remap(filled, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def dress(look: Look, skins: tuple[Floats, ...], rng: np.random.Generator) -> Look:
    """The look with leaves of another species, in two of three plants: with the skin of a real leaf and somewhat other
    colours, with markings along veins, in patches or at the margin, or with leaves of any hue, dark ones included."""
    kind = rng.choice(["as it is", "skin", "marking", "hue"], p=[0.33, 0.37, 0.18, 0.12])
    if kind == "skin":
        skin = skins[rng.integers(len(skins))][:: rng.choice([1, -1]), :: rng.choice([1, -1])]
        mean = np.maximum(skin.mean((0, 1)), 1e-3)
        wanted = 0.07 * 3.2 ** rng.uniform(0, 1) * mean / mean.max() * np.exp(rng.normal(0, 0.15, 3))
        skin = np.ascontiguousarray((skin * wanted / mean).clip(0, 0.9), np.float32)
        return _recolored(replace(look, skin=skin), wanted, rng)
    if kind == "hue":
        hue = rng.choice([rng.uniform(0.12, 0.45), rng.uniform(0.9, 1.1) % 1, rng.uniform(0.75, 0.95)])
        return _recolored(look, hue_color(hue, rng.uniform(0.2, 0.9), 0.03 * 8 ** rng.uniform(0, 1)), rng)
    if kind == "marking":
        hue = rng.choice([rng.uniform(0.1, 0.2), rng.uniform(0.2, 0.35), rng.uniform(0.9, 1.1) % 1])
        marking = Marking(
            color=hue_color(hue, rng.uniform(0.1, 0.9), 0.08 * 6 ** rng.uniform(0, 1)),
            vein=rng.choice([0.0, 1.0, 2.0]),
            blotch=rng.choice([0.0, 0.5, 1.5]),
            edge=rng.choice([0.0, 0.0, 1.5]),
            bias=rng.uniform(-1.2, 0.2),
        )
        return replace(look, marking=marking)
    return look


def _recolored(look: Look, color: Floats, rng: np.random.Generator) -> Look:
    through = color * rng.uniform(0.4, 0.9) * np.array([1.2, 1.2, 0.3 + 0.7 * (color[2] > color[1])])
    return replace(look, leaf=color.astype(np.float32), through=through.astype(np.float32))
