"""Photos of new plants, rendered while a detector trains, each a pure function of its seed. Rays are cast at the size
that the detector trains at, so that nothing is scaled afterwards: leaves of all sizes are equally sharp."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.errors import InputError
from mvseg.evaluation.labelled_photo import LabelledPhoto, label_photo
from mvseg.formats.image_file import read_rgb
from mvseg.formats.photos import photos_in
from mvseg.scene import Cameras
from mvseg.training.photo_faults import draw

if TYPE_CHECKING:
    from mvseg.simulation.growth import SimulatedPlant

BACKGROUND_PX = 768  # limit: longer side at which background photos are kept in memory
MOST_LEAVES = 60  # limit: leaves of a simulated plant


def render_new_plant(seed: int, size: int, backgrounds: tuple[Path, ...] = ()) -> LabelledPhoto:
    """Render one photo of a new plant: any family, 2 to 60 leaves (30 or more in one of four plants), three in five
    wild (see `make_wild`), from any side, from small in the photo to larger than it, some in front of a real photo.

    Args:
        seed: >= 0; the same arguments give the same photo, bit for bit, on one machine.
        size: S; the photo is S x S pixels.
        backgrounds: photos without leaves, to be seen behind a plant whose ground is taken away.

    Raises:
        InputError: a background that cannot be read.
    """
    # embree comes with `pip install mvseg[simulate]`; training on photos alone does not need it
    from mvseg.simulation.families import FAMILIES
    from mvseg.simulation.growth import grow_plant
    from mvseg.simulation.ray_cast import build_stage, render_stage
    from mvseg.simulation.scene_writer import drop_small
    from mvseg.simulation.wild import make_wild

    rng = np.random.default_rng(seed)
    fewest = 30 if rng.random() < 0.25 else 2
    num_leaves = round(math.exp(rng.uniform(math.log(fewest), math.log(MOST_LEAVES))))
    plant = grow_plant(str(rng.choice(list(FAMILIES))), num_leaves, seed)
    plant = make_wild(plant, seed) if rng.random() < 0.6 else plant
    is_cut_out = bool(backgrounds) and rng.random() < 0.4
    if is_cut_out:
        plant = replace(plant, parts=tuple(part for part in plant.parts if part.material != "ground"))
    stage = build_stage(plant, seed=seed)
    shot = render_stage(stage, place_camera(plant, size, rng), 0)
    rgb = shot.rgb
    if is_cut_out:
        behind = cut_background(backgrounds[rng.integers(len(backgrounds))], size, rng)
        rgb = np.where(np.isinf(shot.depth)[..., None], behind, rgb)
    return label_photo(rgb, drop_small(shot.ids, 16))


def place_camera(plant: SimulatedPlant, size: int, rng: np.random.Generator) -> Cameras:
    """One camera of S x S pixels from any side above the ground, that has one leaf of the plant in sight, at 0.6 to 4
    times the focal length that fills the frame."""
    from mvseg.simulation.cameras import arc_cameras

    elevation = math.degrees(math.asin(rng.uniform(-0.05, 0.998)))
    start = rng.uniform(0, 360)
    cameras = arc_cameras(1, plant, start_deg=start, elevations_deg=(elevation,), width=size, height=size)
    leaf = torch.from_numpy(plant.leaves[rng.integers(len(plant.leaves))].vertices.mean(0))
    K = cameras.K.clone()
    K[:, :2, :2] *= math.exp(rng.uniform(math.log(0.6), math.log(4)))
    x, y, z = (cameras.R[0] @ leaf + cameras.t[0]).tolist()
    K[0, 0, 2] = size * rng.uniform(0.2, 0.8) - K[0, 0, 0] * x / z
    K[0, 1, 2] = size * rng.uniform(0.2, 0.8) - K[0, 1, 1] * y / z
    return replace(cameras, K=K)


# --- backgrounds


def list_backgrounds(folder: Path | None) -> tuple[Path, ...]:
    """The photos of a folder in the order of their names; none without one. Raises InputError: no folder or photo."""
    if folder is None:
        return ()
    found = photos_in(folder)
    if not found:
        raise InputError(f"backgrounds is {folder}, expected a folder of photos without leaves")
    return tuple(found)


def cut_background(path: Path, size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(S, S, 3) a random square of a photo, mirrored by chance, scaled to S x S."""
    photo = _read_background(path)
    side = round(min(photo.shape[:2]) * rng.uniform(0.3, 1))
    top, left = (int(rng.integers(length - side + 1)) for length in photo.shape[:2])
    square = photo[top : top + side, left : left + side][:, :: rng.choice([1, -1])]
    return np.asarray(cv2.resize(np.ascontiguousarray(square), (size, size), interpolation=cv2.INTER_AREA), np.uint8)


def draw_background(backgrounds: tuple[Path, ...], photo: Tensor) -> Tensor:
    """(3, H, W) uint8 part of one of the backgrounds, of the size of a photo (3, H, W); torch's generator chooses."""
    rng = np.random.default_rng(int(torch.randint(2**62, ())))
    square = cut_background(backgrounds[rng.integers(len(backgrounds))], max(photo.shape[1:]), rng)
    return torch.from_numpy(square).permute(2, 0, 1)[:, : photo.shape[1], : photo.shape[2]]


@lru_cache(maxsize=64)
def _read_background(path: Path) -> NDArray[np.uint8]:
    photo = read_rgb(path)
    scale = BACKGROUND_PX / max(photo.shape[:2])
    if scale < 1:
        photo = np.asarray(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return photo


def recolor(photo: Tensor, layers: Tensor, background: Tensor) -> Tensor:
    """Colour the leaves of a grey photo (3, H, W) uint8, such as chlorophyll fluorescence, and put them on a background
    (3, H, W) uint8. Its brightness becomes that of the leaves; `layers` (L, H, W) int are k where instance k is. Drawn
    from torch's global generator."""
    labels = layers.amax(0).long()
    grey = photo.float().amax(0)
    bright = grey[labels > 0].quantile(0.9).clamp(min=1) if bool((labels > 0).any()) else grey.new_tensor(255.0)
    tone = (grey / bright).clamp(max=1.4) ** draw(0.5, 1.5)
    tone = tone * (1 + draw(0, 0.3) * torch.randn(int(labels.max()) + 1)[labels]).clamp(0.3, 1.7)
    color = 255 * draw(0.3, 0.9) * torch.tensor([draw(0.3, 0.9), 1.0, draw(0.05, 0.6)])
    cover = torch.nn.functional.avg_pool2d((labels > 0).float()[None], 3, stride=1, padding=1)
    mixed = cover * tone * color[:, None, None] + (1 - cover) * background.float()
    return mixed.round().clamp(0, 255).to(photo.dtype)
