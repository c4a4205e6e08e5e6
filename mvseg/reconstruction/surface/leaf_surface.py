"""A leaf as a surface: the fitted patch, its measures and how far they can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.crop import Crop
from mvseg.findings.finding import list_some
from mvseg.reconstruction.numbers import DOUBTS, FIT, OCCUPANCY
from mvseg.reconstruction.surface.leaf_patch import (
    MIDRIB,
    NUM_COEFFICIENTS,
    cross,
    grid_triangles,
    grid_vertices,
    measure_patch,
    patch_grid,
)
from mvseg.reconstruction.surface.patch_image import draw_polygons, grid_quads
from mvseg.scene import Cameras

T = TypeVar("T")
MESH_SHAPE = (64, 17)  # definition: a mesh has so many rows and columns of vertices


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Cells of a sheet that its leaf covers.

    Attributes:
        shares: `OCCUPANCY.cells` float32, probability that a cell of the sheet is leaf; rows from base to tip.
        area: integral of `shares` over the sheet.
        sd: standard deviation of `area`.
    """

    shares: Tensor
    area: float
    sd: float

    @property
    def is_leaf(self) -> NDArray[np.bool_]:
        """(rows, columns) cells within the outline."""
        return self.shares.numpy() >= 0.5

    def flip(self, *axes: int) -> Occupancy:
        """The same with rows (axis 0) or columns (axis 1) in reverse order."""
        return replace(self, shares=self.shares.flip(axes))


class ByInstance(dict[int, T]):
    """{instance id: shape}; a KeyError says which ids there are."""

    def __missing__(self, instance: int) -> T:
        raise KeyError(f"there is no instance {instance}, expected one of {list_some([str(each) for each in self])}")


@dataclass(frozen=True, eq=False)
class LeafSurface:
    """One leaf (of a compound leaf: one leaflet) as a surface with a rim; world frame and units.

    Attributes:
        coefficients: (26, 3) float64 of the patch (`leaf_patch`); NaN for an instance that has no surface.
        covariance: (78, 78) float64 of `coefficients.ravel()`, calibrated on simulated leaves.
        views: (S,) int64, the views whose masks it was fitted to.
        residual_px: (S,) float64, root mean square distance between its outline and the mask's edge in each view; NaN
            where no part of the outline has an edge of the mask near it.
        iou: (S,) float64, with the mask in each view, without the pixels of instances that may hide it, of the surface
            drawn as much too large or small as the mask seems to be; NaN where the fit did not get that far.
        is_oriented: u runs from the stem to the tip; False where the stem's side cannot be told.
        reasons: {code: sentence} to doubt it, the gravest first; empty for a good one.
        offsets_px: (S,) float64, how much too large its masks were for its first fit, in pixels of that: all masks of a
            scene tell how they err. (0,) where that is not known: of a surface that was read from a file.
        occupancy: where on the surface the leaf is; None: everywhere.
    """

    coefficients: Tensor
    covariance: Tensor
    views: Tensor
    residual_px: Tensor
    iou: Tensor
    is_oriented: bool
    reasons: Mapping[str, str]
    offsets_px: Tensor = field(default_factory=partial(torch.zeros, 0, dtype=torch.float64))
    occupancy: Occupancy | None = None
    _drawn: dict[bytes, Crop] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        why = "; ".join(self.reasons.values()) or "good"
        sizes = f"area {self.area:.4g}, length {self.length:.4g}, {len(self.views)} views; " if self.exists else ""
        return f"LeafSurface({sizes}{why})"

    def __getstate__(self) -> dict[str, Any]:
        """State to pickle, without its drawn masks, which follow from the rest."""
        return self.__dict__ | {"_drawn": {}}

    @staticmethod
    def none(views: Tensor, code: str, reason: str) -> LeafSurface:
        """An instance without a surface, and why."""
        nothing = torch.full((len(views),), torch.nan, dtype=torch.float64)
        return LeafSurface(
            coefficients=torch.full((NUM_COEFFICIENTS, 3), torch.nan, dtype=torch.float64),
            covariance=torch.full((3 * NUM_COEFFICIENTS,) * 2, torch.nan, dtype=torch.float64),
            views=views,
            residual_px=nothing,
            iou=nothing,
            is_oriented=False,
            reasons={code: reason},
        )

    @property
    def exists(self) -> bool:
        """Is there a surface at all?"""
        return bool(self.coefficients.isfinite().all())

    @property
    def is_credible(self) -> bool:
        """May measures of the surface be given at all? False: the instance is better shown as voxels. A patch that
        explains its masks badly is none of a leaf: buds, fruit and stems have no blade."""
        return self.exists and float(self.iou.median()) >= DOUBTS.credible_iou

    def points(self, num_rows: int = MESH_SHAPE[0], num_columns: int = MESH_SHAPE[1]) -> Tensor:
        """(rows, columns, 3) float64 grid from base to tip and from edge to edge; odd columns have the midrib."""
        return torch.from_numpy(patch_grid(num_rows, num_columns).points(self.coefficients.numpy()))

    @cached_property
    def area(self) -> float:
        """One-sided area of the leaf; NaN without a surface."""
        return measure_sizes(self.coefficients.numpy())[0] if self.occupancy is None else self.occupancy.area

    @cached_property
    def length(self) -> float:
        """Length along the midrib from base to tip."""
        return measure_sizes(self.coefficients.numpy())[1]

    @cached_property
    def width(self) -> float:
        """Width from edge to edge along the surface, at the widest place."""
        return measure_sizes(self.coefficients.numpy())[2]

    @cached_property
    def deviations(self) -> tuple[float, float, float]:
        """Standard deviations of area, length and width."""
        grid = patch_grid(*MESH_SHAPE)
        area, length, width = self.deviation(lambda leaves: grid_sizes(grid.points(leaves))).tolist()
        return area if self.occupancy is None else self.occupancy.sd, length, width

    def deviation(self, measure: Callable[[Floats], Floats]) -> Floats:
        """Standard deviations of measures of the surface: those of the coefficients, propagated linearly.

        Args:
            measure: from coefficients of M leaves, (M, 26, 3) float64, to T numbers of each, (M, T) float64. It gets
                the surface moved to the origin, and must be smooth there: an angle must not jump by 360 degrees, nor be
                folded back where it meets 0.

        Returns:
            (T,) float64; NaN without a surface, and for numbers that are NaN.
        """
        center = self.coefficients.numpy().copy()
        center[MIDRIB] -= center[MIDRIB].mean(0)  # neither step nor rounding depend on where the world's origin is
        step = FIT.difference * float(np.linalg.norm(center.std(axis=0)))
        moves = step * np.eye(center.size).reshape(-1, *center.shape)
        with np.errstate(all="ignore"):
            numbers, *moved = measure(np.concatenate((center[None], center + moves, center - moves)))
            slopes = np.subtract(*np.split(np.array(moved), 2)).T / (2 * step)
            variance = np.einsum("ij,jk,ik->i", slopes, self.covariance.numpy(), slopes)
            return np.where(np.isfinite(numbers) & self.exists, np.sqrt(np.maximum(variance, 0)), np.nan)

    @property
    def midrib(self) -> Tensor:
        """(rows, 3) from base to tip."""
        return self.points()[:, MESH_SHAPE[1] // 2]

    @property
    def normal(self) -> Tensor:
        """(3,) unit mean normal of the mesh, weighted by area."""
        mean = cell_normals(self.points().numpy()).sum((0, 1))
        return torch.from_numpy(mean / max(float(np.linalg.norm(mean)), 1e-300))

    def distance_to(self, other: LeafSurface) -> float:
        """Distance between the nearest points of both."""
        points, tree = self.points().reshape(-1, 3).numpy(), cKDTree(other.points().reshape(-1, 3).numpy())
        return float(tree.query(points)[0].min())

    def mesh(self, num_rows: int = 0, num_columns: int = 0) -> trimesh.Trimesh:
        """Open mesh of `points`, whose first vertex is the base and whose last one is the tip; empty without a surface.
        Faces are left out where the leaf is not; 0: as many vertices as that takes. Normals point to the side that most
        cameras of the fit saw."""
        if not self.exists:
            return trimesh.Trimesh()
        if not num_rows:
            rows, columns = OCCUPANCY.cells
            num_rows, num_columns = MESH_SHAPE if self.occupancy is None else (rows + 1, columns + 1)
        vertices = grid_vertices(self.points(num_rows, num_columns).numpy())
        faces = grid_triangles(num_rows, num_columns)
        if self.occupancy is not None:
            places = np.meshgrid(np.linspace(0, 1, num_rows), np.linspace(0, 1, num_columns), indexing="ij")
            corners = grid_vertices(np.stack(places, -1))[faces]
            corners[..., 1][np.isin(faces, (0, len(vertices) - 1))] = np.nan  # the ends have no place across
            row, column = (np.nanmean(corners, axis=1) * OCCUPANCY.cells).astype(int).T
            faces = faces[self.occupancy.is_leaf[row, column]]
        return trimesh.Trimesh(vertices, faces, process=False)

    def project(self, cameras: Cameras) -> list[Tensor]:
        """V masks (H, W) bool on the cameras' device: the pixels that the surface covers half or more of, as if nothing
        hid it. Parts behind a camera are left out."""
        return [
            part.paste((width, height)).to(cameras.device)
            for (width, height), part in zip(cameras.sizes.tolist(), self.project_parts(cameras), strict=True)
        ]

    def project_parts(self, cameras: Cameras) -> list[Crop]:
        """Project as V crops on the CPU; empty ones where the surface is not in the view. Cached by camera."""
        cameras = cameras.to("cpu")
        poses, sizes = cameras.px_from_world.numpy(), cameras.sizes.numpy()
        keys = [pose.tobytes() + size.tobytes() for pose, size in zip(poses, sizes, strict=True)]
        new = [view for view, key in enumerate(keys) if key not in self._drawn]
        if new:
            self._drawn.update(zip((keys[view] for view in new), self._draw_parts(cameras[new]), strict=True))
        return [self._drawn[key] for key in keys]

    def _draw_parts(self, cameras: Cameras) -> list[Crop]:
        sizes = cameras.sizes.tolist()
        nothing = Crop((0, 0, 0, 0), torch.zeros(0, 0, dtype=torch.bool))
        if not self.exists:
            return [nothing] * len(sizes)
        has_holes = self.occupancy is not None
        points = self.points(*(count + 1 for count in OCCUPANCY.cells)) if has_holes else self.points()
        px, depth = cameras.project(points.reshape(-1, 3))
        parts, is_leaf = [], True if self.occupancy is None else self.occupancy.is_leaf.ravel()
        for view, size in enumerate(sizes):
            is_ahead = (grid_quads(depth[view].reshape(*points.shape[:2], 1).numpy()) > 0).all((1, 2))
            quads = grid_quads(px[view].reshape(*points.shape[:2], 2).numpy())[is_ahead & is_leaf]
            low = np.clip(np.floor(quads.min((0, 1), initial=np.inf)), 0, size).astype(int)
            high = np.clip(np.ceil(quads.max((0, 1), initial=-np.inf)), 0, size).astype(int)
            (width, height), corner = (high - low).tolist(), low.astype(float)
            if width <= 0 or height <= 0:
                parts.append(nothing)
                continue
            shown = torch.from_numpy(draw_polygons(quads, (width, height), corner) >= 0.5)
            parts.append(Crop((*low.tolist(), *high.tolist()), shown))
        return parts


def measure_sizes(coefficients: Floats) -> tuple[float, float, float]:
    """Area, length and width."""
    corners = grid_vertices(patch_grid(*MESH_SHAPE).points(coefficients))[grid_triangles(*MESH_SHAPE)]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = measure_patch(coefficients)
    return float(np.linalg.norm(normals, axis=1).sum() / 2), float(size.length), 2 * float(size.half_width)


def grid_sizes(points: Floats) -> Floats:
    """(..., 3) area, length and width of grids (..., rows, columns, 3) whose middle column is the midrib."""
    area = np.linalg.norm(cell_normals(points), axis=-1).sum((-2, -1))
    midrib, across = points[..., points.shape[-2] // 2, :], np.diff(points, axis=-2)
    length = np.linalg.norm(np.diff(midrib, axis=-2), axis=-1).sum(-1)
    return np.stack([area, length, np.linalg.norm(across, axis=-1).sum(-1).max(-1)], -1)


def cell_normals(points: Floats) -> Floats:
    """(..., rows - 1, columns - 1, 3) normals of the cells of grids (..., rows, columns, 3), as long as their areas."""
    down, up = points[..., 1:, 1:, :] - points[..., :-1, :-1, :], points[..., 1:, :-1, :] - points[..., :-1, 1:, :]
    return cross(down, up) / 2
