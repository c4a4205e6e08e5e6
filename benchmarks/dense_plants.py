"""Dense simulated plants with neighbouring opposite leaves, and masks as a person draws them.

Habits of basil, mint and coffee: opposite leaves on short petioles and short internodes, so that in many photos leaves
touch their neighbours. `draw_masks` moves every outline by `OUTLINE_PX`, smoothly along it.
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from benchmarks.label_maps import MIN_PIXELS
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import Plant, grow_plant

HABITS = {
    "basil": replace(
        FAMILIES["ovate"], aspect=(0.5, 0.62), petiole=(0.12, 0.3), elevation=(60, 10), internode=(14, 24),
        per_shoot=10, teeth=0.0, tillers=0.5,
    ),
    "mint": replace(
        FAMILIES["ovate"], length=(30, 55), aspect=(0.45, 0.6), petiole=(0.03, 0.08), elevation=(65, 0),
        internode=(14, 26), teeth=0.05, tillers=0.8,
    ),
    "coffee": replace(
        FAMILIES["ovate"], outline=(0.7, 0.9), length=(90, 140), aspect=(0.36, 0.45), petiole=(0.04, 0.1),
        elevation=(40, -5), internode=(22, 36), divergence=180.0, per_shoot=10, teeth=0.0, ripple=0.1,
    ),
}  # fmt: skip
SIZE, VIEWS = 640, 8
OUTLINE_PX, ALONG_PX = 3.0, 8.0  # standard deviation of an outline, and how far along it errors are alike
FIRST_SEED = 8100  # of plants that are in no other set


def grow_dense(habit: str, num_leaves: int, seed: int) -> tuple[Plant, Cameras]:
    """A plant of one of `HABITS`, and cameras around it."""
    with patch.dict(FAMILIES, HABITS):
        plant = grow_plant(habit, num_leaves, seed)
    cameras = arc_cameras(
        VIEWS, plant, span_deg=360, start_deg=seed, elevations_deg=(15.0, 45.0, 30.0), width=SIZE, height=SIZE
    )
    return plant, cameras


def draw_masks(labels: np.ndarray, seed: int) -> np.ndarray:
    """(H, W) uint16, the same masks with uncertain outlines; where they overlap, the smaller one is on top."""
    rng = np.random.default_rng(seed)
    drawn = np.zeros_like(labels)
    numbers, sizes = np.unique(labels[labels > 0], return_counts=True)
    for number in numbers[np.argsort(-sizes, kind="stable")]:
        rows, columns = np.nonzero(labels == number)
        room = int(4 * OUTLINE_PX)
        part = np.s_[max(rows.min() - room, 0) : rows.max() + room, max(columns.min() - room, 0) : columns.max() + room]
        mask = labels[part] == number
        # white noise, blurred by a Gaussian of this width, has this standard deviation
        noise = gaussian_filter(rng.normal(size=mask.shape), ALONG_PX, mode="wrap") * 2 * np.sqrt(np.pi) * ALONG_PX
        inwards = distance_transform_edt(mask) - distance_transform_edt(~mask)
        drawn[part][inwards > OUTLINE_PX * noise] = number
    sizes = np.bincount(drawn.ravel())
    return np.where(sizes[drawn] >= MIN_PIXELS, drawn, 0).astype(np.uint16)
