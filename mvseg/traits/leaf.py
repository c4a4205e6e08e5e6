"""Sizes and angles of one leaf, each with its standard deviation; see docs/traits.md for the definitions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvseg.arrays import Floats
from mvseg.reconstruction.surface.leaf_patch import patch_basis, patch_grid
from mvseg.reconstruction.surface.leaf_surface import LeafSurface, cell_normals, grid_sizes
from mvseg.reconstruction.voxels import VoxelGrid

COARSE = (24, 9)  # limit: grid for standard deviations
END = 0.25  # chosen: share of the midrib whose direction counts as that of its base or tip; less is noise
MIDDLE = np.linspace(0.4, 0.6, 5)  # where the fold is measured
VAGUE_DEG = 60.0  # chosen: standard deviation from which an azimuth says nothing
PARALLEL = 1e-9  # limit: sine of the angle between directions that span no plane
FULL_TURN_DEG = 360 - 5e-4  # limit: what is larger is written as 360, with six digits


@dataclass(frozen=True)
class Measurement:
    """A number and its standard deviation, each NaN where there is none; `method` is what it was measured on
    ("surface", "voxels", "masks", "photographs"), or the reason why there is none."""

    value: float
    sd: float
    method: str

    @property
    def exists(self) -> bool:
        return bool(np.isfinite(self.value))

    def __format__(self, spec: str) -> str:
        """ "1,091 +- 23", see `say_number`; or the value by a format specification."""
        return format(self.value, spec) if spec else say_number(self.value, self.sd)


def say_number(value: float, sd: float) -> str:
    """A number with two digits of its standard deviation, if known; in ASCII, since some terminals know no more."""
    if not np.isfinite(sd) or sd <= 0:
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    decimals = 1 - int(np.floor(np.log10(sd)))
    return " +- ".join(f"{round(number, decimals):,.{max(decimals, 0)}f}" for number in (value, sd))


def missing(reason: str) -> Measurement:
    """No number, and why."""
    return Measurement(float("nan"), float("nan"), reason)


UP_UNKNOWN = missing("not measured: up is unknown (--up), and no stem tells it")
STEEP = missing("not measured: the leaf points nearly straight up or down")
BASE_UNKNOWN = missing("not measured: base and tip cannot be told apart")
NEED_BASE = ("base_inclination", "tip_inclination", "azimuth", "insertion_height", "insertion_angle")
NEED_UP = ("inclination", *NEED_BASE)


def measure_leaf(surface: LeafSurface, frame: Floats | None, *, ground: float = 0.0) -> dict[str, Measurement]:
    """All of `SURFACE_TRAITS` of one leaf, {trait: number}, from a credible surface; those that need up, or base and
    tip, say so where these are not known. Angles are in degrees.

    Args:
        frame: (3, 3) rows east, north, up (`level_frame`); None: up is not known.
        ground: height that insertion heights start from, along up, world units.
    """
    coefficients = surface.coefficients.numpy()
    normals = cell_normals(patch_grid(*COARSE).points(coefficients))
    directions = _directions(coefficients, frame, normal=normals.sum((0, 1)))
    north = None if frame is None else frame[1]  # azimuths have a plane and a sense of their own
    angles = {name: _Angle.of(*pair, across=north if name == "azimuth" else None) for name, pair in directions.items()}

    def measure(moved: Floats) -> Floats:
        points = patch_grid(*COARSE).points(moved)
        area, length, width = grid_sizes(points).T
        pairs = _directions(moved, frame, normal=cell_normals(points).sum((1, 2)))
        turned = [angle.between(*pairs[name]) for name, angle in angles.items()]
        return np.stack([area, length, width, length / width, _base_height(moved, frame), *turned], 1)

    values = {
        "area": surface.area,
        "length": surface.length,
        "width": surface.width,
        "length_width_ratio": surface.length / surface.width,
        "insertion_height": float(_base_height(coefficients, frame)) - ground,
    }
    values |= {name: angle.degrees for name, angle in angles.items()}
    sds = dict(zip(values, surface.deviation(measure).tolist(), strict=True))
    if frame is not None:
        values["inclination"] = min(values["inclination"], 180 - values["inclination"])
        values["azimuth"] = wrap_azimuth(values["azimuth"])
        values |= {"base_inclination": 90 - values["insertion_angle"], "tip_inclination": 90 - values.pop("tip_angle")}
        sds |= {"base_inclination": sds["insertion_angle"], "tip_inclination": sds.pop("tip_angle")}
    numbers = {name: Measurement(float(value), sds[name], "surface") for name, value in values.items()}
    if surface.occupancy is not None:
        numbers["area"] = measure_area(surface)
    if frame is not None and not numbers["azimuth"].sd <= VAGUE_DEG:
        numbers["azimuth"] = STEEP
    if not surface.is_oriented:
        numbers |= dict.fromkeys(NEED_BASE, BASE_UNKNOWN)
    if frame is None:
        numbers |= dict.fromkeys(NEED_UP, UP_UNKNOWN)
    return numbers


def measure_area(surface: LeafSurface) -> Measurement:
    """Area of a leaf whose surface may explain its masks badly: what no mask confirms adds to its deviation."""
    sd = surface.deviations[0]
    if surface.occupancy is not None:
        return Measurement(surface.area, sd, "surface, occupancy")
    return Measurement(surface.area, max(sd, (1 - float(surface.iou.median())) * surface.area), "surface")


def wrap_azimuth(degrees: float) -> float:
    """In [0, 360), in six digits as well: just below 0 or 360 it is 0. NaN stays NaN."""
    turned = degrees % 360  # of -1e-15 that is 360
    return 0.0 if turned >= FULL_TURN_DEG else turned


def measure_voxels(grid: VoxelGrid) -> dict[str, Measurement]:
    """All of `VOXEL_TRAITS`: volume, the corners of the box along the world's axes, and its components."""
    points, half = grid.points, grid.voxel_size / 2
    values = {"volume": grid.volume, "num_pieces": float(grid.num_pieces)}
    for end, corner in (("min", points.amin(0) - half), ("max", points.amax(0) + half)):
        values |= {f"{axis}_{end}": float(value) for axis, value in zip("xyz", corner, strict=True)}
    return {name: Measurement(value, float("nan"), "voxels") for name, value in values.items()}


# The midrib at the base, where that ends, where the tip begins, and at the tip: (4, 26).
_ENDS = patch_basis(np.array([0.0, END, 1 - END, 1.0]), np.zeros(4))
# One edge, the midrib and the other edge at mid length: (3, 26).
_HALVES = np.stack([patch_basis(MIDDLE, np.full(len(MIDDLE), v)).mean(0) for v in (-1.0, 0.0, 1.0)])


def _base_height(coefficients: Floats, frame: Floats | None) -> Floats:
    base = _ENDS[0] @ coefficients
    return np.full(base.shape[:-1], np.nan) if frame is None else base @ frame[2]


def _directions(coefficients: Floats, frame: Floats | None, *, normal: Floats) -> dict[str, tuple[Floats, Floats]]:
    """{angle: the two directions (..., 3) that it lies between} of leaves (..., 26, 3) with mean normals (..., 3)."""
    ends, (left, middle, right) = (np.moveaxis(rows @ coefficients, -2, 0) for rows in (_ENDS, _HALVES))
    base, ahead, tip = ends[1:] - ends[:-1]
    pairs = {"curvature": (base, tip), "fold_angle": (left - middle, right - middle)}
    if frame is None:
        return pairs
    east, _, up = frame
    level = ahead - (ahead @ up)[..., None] * up
    return pairs | {
        "inclination": (up, normal), "insertion_angle": (up, base), "tip_angle": (up, tip), "azimuth": (east, level)
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Angle:
    """An angle in the plane of orthonormal `ahead` and `across`, signed: it has no kink at 0 and 180 degrees."""

    ahead: Floats
    across: Floats
    degrees: float

    @staticmethod
    def of(start: Floats, end: Floats, *, across: Floats | None = None) -> _Angle:
        ahead, size = start / np.linalg.norm(start), float(np.linalg.norm(end))
        if across is not None:
            sine = float(end @ across)
        else:
            across = end - (end @ ahead) * ahead
            sine = float(np.linalg.norm(across))
            if sine <= PARALLEL * size:
                across = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
            across = across / np.linalg.norm(across)
        return _Angle(ahead, across, float(np.degrees(np.arctan2(sine, end @ ahead))) if size > 0 else np.nan)

    def between(self, start: Floats, end: Floats) -> Floats:
        """(M,) degrees between M pairs of directions (M, 3), or one (3,), within half a turn of the leaf as fitted."""
        first, second = (d @ self.ahead + 1j * (d @ self.across) for d in (start, end))
        turned = second * first.conjugate() * np.exp(-1j * np.radians(self.degrees))
        return self.degrees + np.degrees(np.angle(turned))
