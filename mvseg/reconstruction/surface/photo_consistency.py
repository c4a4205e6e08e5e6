"""What the photos say about the shape of a leaf between its outlines: its texture must lie where all views see it.

The luminance at the points of a grid on the patch, in every view that surely sees them, is normalised over a window on
the surface (mean 0, deviation 1: gain and offset do not matter) and compared with the mean of the views that see the
same side. Linearised, that gives Gauss-Newton equations for the coefficients, which stand beside those of the outlines.
Where there is no texture, or where the views do not agree on it, they say next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.reconstruction.surface.leaf_patch import Floats, measure_patch, patch_basis, patch_grid
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.patch_image import project_points

COARSE_PX, FINE_PX = 4.0, 1.5  # between the points of the grid, in working pixels of a middling view
LEAST_POINTS, MOST_POINTS = (12, 5), (80, 41)  # of the grid, along and across
END, EDGE = 0.04, 0.94  # the grid leaves out this much of the midrib at both ends, and begins there beside the rim
BLUR, LEAST_BLUR_PX = 0.4, 0.5  # of the photos, in steps of the grid and in working pixels
WINDOW = 3.5  # deviation of the window in which the luminance is normalised, in steps of the grid
NOISE = 4.0  # grey levels: contrasts below it are taken for noise
MARGIN_PX = 2.5  # working pixels inside a mask from which it is believed
OBLIQUE = 0.2, 0.5  # cosines between normal and ray: views count not at all below the first, fully from the second on
BEHIND = 0.08  # of the length: a part of the patch that is this much farther away than another one is hidden by it
CELL_PX = 3.0  # of the depth buffer in which that is looked up, working pixels
WEIGHT = 0.27  # of a working pixel
ROBUST = 1.0  # normalised residual that counts half
LEAST_OTHERS = 0.2  # weight of the other views at a point; below it a view has nothing to be compared with

Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LeafPhotos:
    """The photos around one leaf, at a resolution that is fine enough for its fit.

    Attributes:
        grey: S crops (rows, columns) float32, luminance from 0 to 255; 0 outside the photo.
        inside: S crops (rows, columns) float32, working pixels from the edge of the leaf's own mask; 0 outside of it.
        corners: (S, 2) x, y of the top-left pixel of each crop.
        scales: (S, 2) pixels per working pixel.
    """

    grey: tuple[NDArray[np.float32], ...]
    inside: tuple[NDArray[np.float32], ...]
    corners: Floats
    scales: Floats

    def local(self, index: int, px: Floats) -> Floats:
        """(P, 2) positions in a crop, in working pixels, whose centres are whole numbers."""
        return (px - self.corners[index]) / self.scales[index] - 0.5


def crop_photos(
    stacks: Mapping[int, MaskStack], photos: Callable[[int], NDArray[np.uint8]], *, sizes: Sequence[Sequence[int]]
) -> dict[int, LeafPhotos]:
    """The photos around every leaf; each photo is read once, and one is held at a time.

    Args:
        stacks: instance id -> its masks.
        photos: view index -> (H, W, 3) uint8 RGB.
        sizes: width and height of each view.

    Raises:
        InputError: a photo is of another size.
    """
    greys: dict[int, list[NDArray[np.float32]]] = {instance: [] for instance in stacks}
    for view in sorted({view for masks in stacks.values() for view in masks.views.tolist()}):
        photo, (width, height) = photos(view), sizes[view]
        if photo.shape != (height, width, 3):
            raise InputError(f"the photo of view {view} is of shape {photo.shape}, expected ({height}, {width}, 3)")
        luminance = np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        for instance, masks in stacks.items():
            for index in np.flatnonzero(masks.views == view).tolist():  # views are in ascending order
                greys[instance].append(_cut(masks, index, luminance))
    return {instance: _leaf_photos(masks, tuple(greys[instance])) for instance, masks in stacks.items()}


def _cut(masks: MaskStack, index: int, luminance: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A crop of a photo at the working resolution."""
    rows, columns = masks.shapes[index].tolist()
    x, y = masks.corners[index].astype(int).tolist()
    height, width = luminance.shape
    x1, y1, x2, y2 = max(x, 0), max(y, 0), min(x + columns, width), min(y + rows, height)
    crop = np.zeros((rows, columns), np.float32)
    crop[y1 - y : y2 - y, x1 - x : x2 - x] = luminance[y1:y2, x1:x2]
    return _shrink(crop, masks.enlargement)


def _shrink(crop: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    if factor <= 1:
        return crop
    size = [max(2, round(side / factor)) for side in crop.shape[::-1]]
    return np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _leaf_photos(masks: MaskStack, grey: tuple[NDArray[np.float32], ...]) -> LeafPhotos:
    inside = []
    for index in range(len(masks)):
        own = _shrink(masks.crop(masks.inside, index).astype(np.float32), masks.enlargement) > 0.5
        inside.append(cv2.distanceTransform(own.astype(np.uint8), cv2.DIST_L2, 5).astype(np.float32))
    shapes = np.array([crop.shape for crop in grey])
    return LeafPhotos(
        grey=grey, inside=tuple(inside), corners=masks.corners, scales=(masks.shapes / shapes)[:, ::-1].astype(float)
    )


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """(rows, columns) points evenly spread in u and v: their basis (P, 26) and its derivatives by u and by v."""

    shape: tuple[int, int]
    basis: Floats
    by_u: Floats
    by_v: Floats


@cache
def surface_grid(num_rows: int, num_columns: int) -> SurfaceGrid:
    """A grid without the ends and the rim; treat its arrays as constants."""
    u, v = np.linspace(END, 1 - END, num_rows), np.linspace(-EDGE, EDGE, num_columns)
    u, v = (x.ravel() for x in np.meshgrid(u, v, indexing="ij"))
    h = 1e-3
    return SurfaceGrid(
        shape=(num_rows, num_columns),
        basis=patch_basis(u, v),
        by_u=(patch_basis(u + h, v) - patch_basis(u - h, v)) / (2 * h),
        by_v=(patch_basis(u, v + h) - patch_basis(u, v - h)) / (2 * h),
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """The views of a leaf, ready to be compared at the points of a grid on its patch.

    Attributes:
        px_from_world: (S, 3, 4).
        photos: what the crops of `images` belong to.
        images: S crops (rows, columns, 3) float32: luminance without the frequencies that the grid does not resolve,
            and its slopes along x and y per pixel.
        grid: P points.
        weight: (S, P) how surely and how squarely each view sees each point, 0 to 1.
        is_upper: (S, P) which side it sees.
        spacing: working pixels between the points, in a middling view.
        width: of the patch where it is widest, working pixels in a middling view.
    """

    px_from_world: Floats
    photos: LeafPhotos
    images: tuple[NDArray[np.float32], ...]
    grid: SurfaceGrid
    weight: Floats
    is_upper: Bools
    spacing: float
    width: float


def compare_views(masks: MaskStack, photos: LeafPhotos, coefficients: Floats, *, step_px: float) -> Comparison:
    """Choose a grid of about `step_px` working pixels and find out what sees its points on the patch (26, 3)."""
    size = measure_patch(coefficients)
    px = project_points(masks.px_from_world, patch_grid(36, 9).points(coefficients)).px / photos.scales[:, None, None]
    length = float(np.median(np.linalg.norm(np.diff(px[:, :, 4], axis=1), axis=2).sum(1)))
    width = float(np.median(np.linalg.norm(np.diff(px, axis=2), axis=3).sum(2).max(1)))
    steps = np.array([length, length * 2 * size.half_width / size.length]) / step_px
    num_rows, num_columns = np.clip(np.round(steps), LEAST_POINTS, MOST_POINTS).astype(int).tolist()
    grid = surface_grid(num_rows, num_columns)
    spacing = length / num_rows
    weight, is_upper = _see(masks, photos, coefficients, grid=grid)
    return Comparison(
        px_from_world=masks.px_from_world,
        photos=photos,
        images=_smooth(photos, max(LEAST_BLUR_PX, BLUR * spacing)),
        grid=grid,
        weight=weight,
        is_upper=is_upper,
        spacing=spacing,
        width=width,
    )


def _smooth(photos: LeafPhotos, blur_px: float) -> tuple[NDArray[np.float32], ...]:
    """Blurred luminance and slopes; what lies outside the mask is left out of the blur."""
    images = []
    for grey, inside, scale in zip(photos.grey, photos.inside, photos.scales, strict=True):
        own = (inside > 0).astype(np.float32)
        share = cv2.GaussianBlur(own, (0, 0), blur_px)
        smooth = cv2.GaussianBlur(grey * own, (0, 0), blur_px) / np.maximum(share, 1e-3)
        by_row, by_column = np.gradient(smooth)
        images.append(np.stack([smooth, by_column / scale[0], by_row / scale[1]], 2).astype(np.float32))
    return tuple(images)


def _project(px_from_world: Floats, points: Floats) -> tuple[Floats, Floats]:
    """(S, P, 2) and depths (S, P) of points (P, 3)."""
    projection = project_points(px_from_world, points[:, None])
    return projection.px[:, :, 0], projection.depth[:, :, 0]


def _see(masks: MaskStack, photos: LeafPhotos, coefficients: Floats, *, grid: SurfaceGrid) -> tuple[Floats, Bools]:
    """Weight (S, P) of each view at each point of the grid, and does it see the upper side?"""
    points = grid.basis @ coefficients
    px, depth = _project(masks.px_from_world, points)
    normals = np.cross(grid.by_u @ coefficients, grid.by_v @ coefficients)
    matrices = masks.px_from_world
    centres = -np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[..., 0]
    rays = points - centres[:, None]
    lengths = np.linalg.norm(rays, axis=2) * np.linalg.norm(normals, axis=1)
    cosine = (rays * normals).sum(2) / np.maximum(lengths, 1e-12)
    weight = np.clip((np.abs(cosine) - OBLIQUE[0]) / (OBLIQUE[1] - OBLIQUE[0]), 0, 1)
    margin = BEHIND * measure_patch(coefficients).length
    for index, inside in enumerate(photos.inside):
        local = photos.local(index, px[index])
        weight[index] *= _sample(inside[..., None], local)[:, 0] >= MARGIN_PX
        cell = np.floor(local / CELL_PX).astype(np.int64)
        _, cell = np.unique(cell, axis=0, return_inverse=True)
        nearest = np.full(cell.max() + 1, np.inf)
        np.minimum.at(nearest, cell.ravel(), depth[index])
        weight[index] *= depth[index] < nearest[cell.ravel()] + margin
    return weight, cosine < 0


def _sample(image: NDArray[np.float32], local: Floats) -> Floats:
    """(P, n) values of an image (rows, columns, n) at positions (P, 2), bilinear; the border goes on outside."""
    rows, columns = image.shape[:2]
    x, y = np.clip(local[:, 0], 0, columns - 1.001), np.clip(local[:, 1], 0, rows - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    x, y = (x - column)[:, None], (y - row)[:, None]
    flat = image.reshape(rows * columns, -1)
    first = row * columns + column
    top = flat[first] * (1 - x) + flat[first + 1] * x
    bottom = flat[first + columns] * (1 - x) + flat[first + columns + 1] * x
    return np.asarray(top * (1 - y) + bottom * y, dtype=float)


@dataclass(frozen=True, eq=False)
class Residuals:
    """What the views say at the points of the grid, normalised.

    Attributes:
        value: (S, P) mean of the views that see the same side, minus this one.
        slope: (S, P, 3) change of `-value` per world unit that the point moves.
        weight: (S, P).
        agreement: correlation of the views, each with the mean of the others; 1 for the same texture, 0 for noise.
    """

    value: Floats
    slope: Floats
    weight: Floats
    agreement: float


def photo_residuals(comparison: Comparison, coefficients: Floats) -> Residuals:
    """By how much the views differ on the patch (26, 3)."""
    z, slope = _normalised(comparison, coefficients)
    value, weight = np.zeros_like(z), np.zeros_like(z)
    others = np.zeros_like(z)
    for is_upper in (True, False):
        here = comparison.weight * (comparison.is_upper == is_upper)
        total = here.sum(0)
        mean = (here * z).sum(0) / np.maximum(total, 1e-9)
        mean_slope = (here[..., None] * slope).sum(0) / np.maximum(total, 1e-9)[:, None]
        rest = total - here
        counts = (here > 0) & (rest > LEAST_OTHERS)
        value = np.where(counts, mean - z, value)
        slope = np.where(counts[..., None], slope - mean_slope, slope)
        others = np.where(counts, (total * mean - here * z) / np.maximum(rest, 1e-9), others)
        weight = np.where(counts, here, weight)
    power = (weight * z**2).sum() * (weight * others**2).sum()
    agreement = (weight * z * others).sum() / max(np.sqrt(power), 1e-9)
    return Residuals(value=value, slope=slope, weight=weight, agreement=float(agreement))


def _normalised(comparison: Comparison, coefficients: Floats) -> tuple[Floats, Floats]:
    """Luminance (S, P) over its mean in a window on the surface, in deviations in that window; and its slope (S, P, 3).

    The slope leaves out that mean and deviation change as well: over a window the change is next to nothing.
    """
    grid, matrices = comparison.grid, comparison.px_from_world
    px, depth = _project(matrices, grid.basis @ coefficients)
    samples = np.stack([
        _sample(image, comparison.photos.local(index, px[index])) for index, image in enumerate(comparison.images)
    ])  # fmt: skip
    mass = np.maximum(_blur(grid, comparison.weight), 1e-6)
    high = samples[..., 0] - _blur(grid, comparison.weight * samples[..., 0]) / mass
    deviation = np.sqrt(_blur(grid, comparison.weight * high**2) / mass + NOISE**2)
    px_slope = (matrices[:, None, :2, :3] - px[..., None] * matrices[:, None, 2:, :3]) / depth[..., None, None]
    slope = (samples[..., 1:, None] * px_slope).sum(2)
    return high / deviation, slope / deviation[..., None]


def _blur(grid: SurfaceGrid, values: Floats) -> Floats:
    """(S, P) Gaussian mean over the grid, with nothing outside of it."""
    maps = values.reshape(-1, *grid.shape)
    return np.stack([
        cv2.GaussianBlur(one, (0, 0), WINDOW, borderType=cv2.BORDER_CONSTANT).ravel() for one in maps
    ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class PhotoEquations:
    """Normal equations: matrix (78, 78) and right side (78,), in units of the outlines' (one pixel)."""

    matrix: Floats
    right: Floats


def photo_equations(comparison: Comparison, coefficients: Floats) -> PhotoEquations:
    """What the photos ask of the coefficients (26, 3), about the present ones."""
    residuals = photo_residuals(comparison, coefficients)
    trust = WEIGHT * comparison.spacing**2 * max(0.0, residuals.agreement)
    weight = trust * residuals.weight / (1 + (residuals.value / ROBUST) ** 2)
    weighted = weight[..., None] * residuals.slope
    square = np.einsum("spa,spb->pab", weighted, residuals.slope)
    basis = comparison.grid.basis
    count = basis.shape[1]
    matrix = np.einsum("pi,pabj->iajb", basis, square[..., None] * basis[:, None, None], optimize=True)
    right = basis.T @ (weighted * residuals.value[..., None]).sum(0)
    return PhotoEquations(matrix=matrix.reshape(3 * count, 3 * count), right=right.ravel())
