"""Wrong poses, as users bring them: noise, the cameras of other photos, two photos swapped, the reverse order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mvseg.scene import Cameras, nearest_point

# "rotated 5": every camera turned by noise of 5 pixels; "moved 5": shifted by it; "shifted 1": the cameras of the next
# photo, those of the first for the last; "swapped": those of two photos; "mirrored": in the reverse order.
FAULTS = (
    *(f"{kind} {px}" for kind in ("rotated", "moved") for px in (3, 5, 10, 20)),
    "shifted 1",
    "shifted 2",
    "shifted 3",
    "shifted -1",
    "swapped",
    "mirrored",
)


def faulty_cameras(cameras: Cameras, fault: str, rng: np.random.Generator) -> Cameras:
    """The cameras with one of `FAULTS`, or as they are ("exact")."""
    kind, *numbers = fault.split()
    order = np.arange(len(cameras))
    if kind == "rotated":
        return rotate_cameras(cameras, float(numbers[0]), rng)
    if kind == "moved":
        return move_cameras(cameras, float(numbers[0]), rng)
    if kind == "shifted":
        order = np.roll(order, -int(numbers[0]))
    elif kind == "swapped":
        first, second = rng.choice(len(cameras), 2, replace=False)
        order[[first, second]] = second, first
    elif kind == "mirrored":
        order = order[::-1].copy()
    return replace(cameras, R=cameras.R[order], t=cameras.t[order])


def rotate_cameras(cameras: Cameras, px: float, rng: np.random.Generator) -> Cameras:
    """Every camera turned about its centre, about each of its axes by an angle of standard deviation `px` / f."""
    turns = [Rotation.from_rotvec(rng.normal(0, px / float(K[0, 0]), 3)).as_matrix() for K in cameras.K]
    turn = torch.from_numpy(np.stack(turns))
    return replace(cameras, R=turn @ cameras.R, t=(turn @ cameras.t[:, :, None])[:, :, 0])


def move_cameras(cameras: Cameras, px: float, rng: np.random.Generator) -> Cameras:
    """Every camera shifted along each of its axes, so that what all look at moves by about `px` pixels."""
    distance = (cameras.centers - nearest_point(cameras.centers, cameras.R[:, 2])).norm(dim=1)
    shift = rng.normal(0, 1, (len(cameras), 3)) * (px * distance / cameras.K[:, 0, 0]).numpy()[:, None]
    return replace(cameras, t=cameras.t + torch.from_numpy(shift))
