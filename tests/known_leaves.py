"""Leaf surfaces of known shape: patches fitted to points of planes, cylinders and folded sheets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, NUM_COEFFICIENTS, patch_grid
from mvseg.reconstruction.surface.leaf_surface import LeafSurface

Sheet = Callable[[Floats, Floats], Floats]  # (along, across) in world units -> (..., 3) points


def fit_coefficients(sheet: Sheet, *, length: float, half_width: float) -> Floats:
    """(26, 3) of an elliptic leaf on a sheet: along from 0 to `length`, across up to `half_width` on either side."""
    grid = patch_grid(80, 21)
    u, v = np.meshgrid(grid.u, grid.v, indexing="ij")
    points = sheet(length * u, half_width * v * np.sqrt(4 * u * (1 - u)))
    return np.linalg.lstsq(grid.basis, points.reshape(-1, 3), rcond=None)[0]


def make_surface(
    coefficients: Floats, *, sd: float = 0.01, is_oriented: bool = True, iou: float = 0.95, num_views: int = 6
) -> LeafSurface:
    """A surface whose coefficients have independent errors of this standard deviation."""
    return LeafSurface(
        coefficients=torch.from_numpy(np.asarray(coefficients, dtype=np.float64)),
        covariance=sd**2 * torch.eye(3 * NUM_COEFFICIENTS, dtype=torch.float64),
        views=torch.arange(num_views),
        residual_px=torch.full((num_views,), 0.2, dtype=torch.float64),
        iou=torch.full((num_views,), iou, dtype=torch.float64),
        is_oriented=is_oriented,
        reasons={},
    )


def flat_sheet(along: Floats, across: Floats) -> Floats:
    return np.stack([along, across, 0 * along], -1)


def bent_sheet(radius: float) -> Sheet:
    """Bends down over a cylinder: the direction at `along` is -along / radius from the horizontal."""
    return lambda along, across: np.stack(
        [radius * np.sin(along / radius), across, radius * (np.cos(along / radius) - 1)], -1
    )


def folded_sheet(angle_deg: float) -> Sheet:
    """Two flat halves, turned up, at this angle to each other."""
    lift = np.radians(90 - angle_deg / 2)
    return lambda along, across: np.stack([along, across * np.cos(lift), np.abs(across) * np.sin(lift)], -1)


def flat_leaf(
    *, length: float = 40.0, half_width: float = 10.0, at: tuple[float, float, float] = (0, 0, 0), **traits: float
) -> LeafSurface:
    """An ellipse in the horizontal plane whose base is at a place, and whose tip lies in the direction of +x."""
    coefficients = fit_coefficients(flat_sheet, length=length, half_width=half_width)
    coefficients[MIDRIB] += at
    return make_surface(coefficients, **traits)  # type: ignore[arg-type]


def bent_blade(*, length: float = 40.0, bend_deg: float = 60.0, half_width: float = 8.0) -> LeafSurface:
    """A leaf that leaves its base horizontally towards +x, and points down by `bend_deg` at its tip."""
    sheet = bent_sheet(length / np.radians(bend_deg))
    return make_surface(fit_coefficients(sheet, length=length, half_width=half_width))


def move(
    surface: LeafSurface, turn: Floats, *, scale: float = 1.0, shift: tuple[float, float, float] = (0, 0, 0)
) -> LeafSurface:
    """The surface after x -> scale * turn @ x + shift."""
    full = torch.from_numpy(np.kron(np.eye(NUM_COEFFICIENTS), scale * turn))
    coefficients = scale * surface.coefficients @ torch.from_numpy(turn).T
    coefficients[MIDRIB] += torch.tensor(shift, dtype=torch.float64)
    return replace(surface, coefficients=coefficients, covariance=full @ surface.covariance @ full.T)


def turn_about(axis: Floats, degrees: float) -> Floats:
    """(3, 3) rotation matrix."""
    unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), unit)
    return np.eye(3) + np.sin(np.radians(degrees)) * cross + (1 - np.cos(np.radians(degrees))) * cross @ cross
