"""Back-projection of each instance into voxels (Eq. 6), and their points and mesh."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from mvseg.errors import InputError, InputWarning
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar

SEARCH_CELLS = 24  # the search for the box of an instance ends at so many cells along it
MAX_CELLS = 100_000  # or when there are so many cells (a technical limit)
MAX_VOXELS = 200_000_000  # a grid has at most so many voxels (a technical limit)
CRUMB = 0.02  # a piece is a crumb if it has less than this share of the voxels of the largest piece


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """One instance in 3D.

    Attributes:
        origin: (3,) float64, world position of the corner of voxel (0, 0, 0); voxel (a, b, c) is centred at
            origin + voxel_size * (a + 0.5, b + 0.5, c + 0.5).
        voxel_size: edge length in world units.
        votes: (X, Y, Z) float32 in [0, 1]: share of the instance's views whose mask contains the centre (I_k, Eq. 6);
            0 where `ReconstructConfig.seen_share` forbids the voxel, and in crumbs that were dropped.
        num_views: views that could vote.
        threshold: a voxel is occupied when its share exceeds this.
    """

    origin: Tensor
    voxel_size: float
    votes: Tensor
    num_views: int
    threshold: float

    @property
    def occupied(self) -> Tensor:
        """(X, Y, Z) bool."""
        return self.votes > self.threshold + 1e-6

    @property
    def points(self) -> Tensor:
        """(P, 3) float64: world positions of the centres of the occupied voxels."""
        return self.origin + self.voxel_size * (self.occupied.nonzero().double() + 0.5)

    @property
    def volume(self) -> float:
        """Occupied volume in cubed world units."""
        return int(self.occupied.sum()) * self.voxel_size**3

    @property
    def num_pieces(self) -> int:
        """How many pieces the occupied voxels fall into.

        Voxels that share a face are of one piece; those that share only an edge or a corner are not: in the mesh they
        come apart, as a rule.
        """
        return len(self._pieces()[1])

    def without_crumbs(self, least_share: float = CRUMB) -> VoxelGrid:
        """The grid without pieces that have fewer voxels than this share of the largest one.

        Their votes become 0, so that they are gone from points, volume and mesh alike.
        """
        piece, sizes = self._pieces()
        if not len(sizes) or sizes.min() >= least_share * sizes.max():
            return self
        is_crumb = np.append(False, sizes < least_share * sizes.max())[piece]
        return replace(self, votes=self.votes.masked_fill(torch.from_numpy(is_crumb).to(self.votes.device), 0))

    def _pieces(self) -> tuple[np.ndarray, np.ndarray]:
        """(X, Y, Z) piece of each voxel, from 1 on, 0 where it is free; (pieces,) their numbers of voxels."""
        piece, _ = ndimage.label(self.occupied.cpu().numpy())
        return piece, np.bincount(piece.ravel())[1:]

    def mesh(self) -> trimesh.Trimesh:
        """Closed surface of the occupied voxels (marching cubes between the last free and the first occupied share).

        World coordinates, faces outward; an empty mesh when no voxel is occupied.
        """
        if not self.occupied.any():
            return trimesh.Trimesh()
        votes = np.pad(self.votes.cpu().numpy(), 1)
        level = (np.floor(self.threshold * self.num_views + 1e-6) + 0.5) / self.num_views
        vertices, faces, _, _ = marching_cubes(votes, level, gradient_direction="ascent")
        world = self.origin.cpu().numpy() + self.voxel_size * (vertices - 0.5)
        return trimesh.Trimesh(world, faces, process=False)


def reconstruct_instances(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    config: ReconstructConfig = ReconstructConfig(),
) -> dict[int, VoxelGrid]:
    """Back-project every instance that is seen in at least two views.

    Departs from the paper by `config.seen_share`, which brings shapes closer to the true leaves (docs/benchmarks.md).

    Args:
        regions: D regions.
        instance_ids: (D,) int64, from 1 on; -1 = matched to nothing.
        cameras: V cameras.
        config: thresholds and voxel size.

    Returns:
        {instance id: grid}, votes on the device of the regions. Instances seen in one view only are left out: they have
        no bounded shape. So are, with an InputWarning, those in which no voxel has enough votes.

    Raises:
        InputError: the ids are not one per region; see also `back_project`.
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected one per region")
    shapes, free = {}, None
    if config.seen_share > 0:
        ones = torch.ones_like(instance_ids)
        sizes = enumerate(cameras.sizes.tolist())
        free = {view: regions.label_map(view, ones, size) == 0 for view, size in sizes}
    instances = instance_ids[instance_ids > 0].unique().tolist()
    for instance in progress_bar(instances, name="back-projection", unit="instance"):
        members = regions.select(instance_ids == instance)
        grid = back_project(members, cameras, config=config, free=free)
        if grid is not None and grid.occupied.any():
            shapes[instance] = grid
        elif len(members.view_index.unique()) > 1:
            message = f"instance {instance} has no shape: its {len(members)} masks agree on no point"
            warnings.warn(message, InputWarning, stacklevel=2)
    return shapes


def back_project(
    members: Regions,
    cameras: Cameras,
    *,
    config: ReconstructConfig = ReconstructConfig(),
    free: Mapping[int, Tensor] | None = None,
) -> VoxelGrid | None:
    """The voxels of one instance from all of its masks (Eq. 6), in its own bounding box.

    Departures from the paper: several masks of one view (pieces of a split mask) vote as one, their union; a voxel
    needs *more* than the threshold, so that of two views both must agree. Voxels behind a camera or outside its image
    get no vote there. The grid is aligned to multiples of the voxel size: grids of one size share their lattice.

    Args:
        members: the masks of the instance.
        cameras: V cameras.
        config: threshold, voxel size (world units) or voxel budget.
        free: view -> (H, W) bool, where it shows no region of any instance, for `config.seen_share`; of every view
            with a mask. None: no pixel is known to be free, which leaves the paper's rule.

    Returns:
        The grid, or None for an instance seen in fewer than two views or without a common point. Warns (InputWarning)
        when the common part is unbounded, as with nearly parallel views, and had to be cut off.

    Raises:
        InputError: a voxel size that asks for more than 2e8 voxels.
    """
    cameras = cameras.to(members.device)
    views = members.view_index[members.areas > 0].unique().tolist()
    masks = [_ViewMask.union(members, view, cameras) for view in views]
    if len(masks) < 2:
        return None
    middle = cameras.nearest_point(torch.tensor(views), torch.stack([mask.ray for mask in masks]))
    box = _bounding_box(masks, middle, config.threshold)
    if box is None:
        return None
    low, high = box
    size = config.voxel_size or float(((high - low).prod() / config.voxel_budget) ** (1 / 3))
    first, last = (low / size).floor(), (high / size).ceil()
    shape = (last - first).long().clamp(min=1)
    if float((last - first).prod()) > MAX_VOXELS:
        asked = int((last - first).prod())
        raise InputError(f"a voxel size of {size:g} asks for {asked} voxels, expected at most {MAX_VOXELS}")
    axes = [(first[a] + 0.5 + torch.arange(int(shape[a])).to(low)) * size for a in range(3)]
    free_maps = None if config.seen_share == 0 or free is None else [free[view].to(members.device) for view in views]
    votes = _share_of_masks(masks, axes, free=free_maps, seen_share=config.seen_share)
    return VoxelGrid(
        origin=first * size, voxel_size=size, votes=votes, num_views=len(masks), threshold=config.threshold
    )


@dataclass(frozen=True, eq=False)
class _ViewMask:
    """The union of an instance's masks in one view."""

    mask: Tensor  # (h, w) bool, a crop
    corner: tuple[int, int]  # x, y of the crop's top-left pixel
    px_from_world: Tensor  # (3, 4) float64
    focal: float
    slant: float  # largest distance from the camera per unit of depth, over the rays of the crop
    center: Tensor  # (3,) camera centre
    ray: Tensor  # (3,) unit viewing ray through the mask's centroid

    @staticmethod
    def union(members: Regions, view: int, cameras: Cameras) -> _ViewMask:
        crop = members.union((members.view_index == view).nonzero()[:, 0].tolist())
        x1, y1, x2, y2 = crop.box
        rows, columns = crop.pixels.nonzero().double().mean(0) + 0.5
        ray = cameras.world_from_px[view] @ torch.stack((columns + x1, rows + y1, torch.ones_like(rows)))
        ray = ray / torch.linalg.vector_norm(ray)
        K = cameras.K[view]
        corners = torch.tensor([[u, v, 1.0] for u in (x1, x2) for v in (y1, y2)]).to(K)
        slant = float(torch.linalg.vector_norm(corners @ torch.linalg.inv(K).T, dim=1).max())
        focal = float(K.diagonal()[:2].max())
        return _ViewMask(
            mask=crop.pixels,
            corner=(x1, y1),
            px_from_world=cameras.px_from_world[view],
            focal=focal,
            slant=slant,
            center=cameras.centers[view],
            ray=ray,
        )

    @cached_property
    def integral(self) -> Tensor:
        """((h + 1) * (w + 1),) int: pixels of the mask above and to the left of each pixel corner, row by row."""
        return torch.nn.functional.pad(self.mask.int().cumsum(0).cumsum(1), (1, 0, 1, 0)).flatten()

    def contains(self, axes: list[Tensor]) -> Tensor:
        """(X, Y, Z) bool: L of Eq. 6 on a grid: is the point in front of the camera, and its pixel in the mask?"""
        return self.look_up(axes, self.mask, self.corner)

    def look_up(self, axes: list[Tensor], mask: Tensor, corner: tuple[int, int]) -> Tensor:
        """(X, Y, Z) bool: the same for any mask (h, w) of this view whose top-left pixel is `corner` (x, y).

        Computed relative to the first point, so that float32 is exact to a thousandth of a pixel wherever the world's
        origin is.
        """
        first = torch.stack([axis[0] for axis in axes])
        offset = (self.px_from_world[:, :3] @ first + self.px_from_world[:, 3]).float()
        x, y, z = ((axis - axis[0]).float() for axis in axes)
        x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
        rows = self.px_from_world.float()
        u, v, depth = (row[0] * x + row[1] * y + (row[2] * z + start) for row, start in zip(rows, offset, strict=True))
        scale = 1 / depth.clamp(min=1e-12)
        height, width = mask.shape
        # A border of one False pixel receives everything that falls outside.
        framed = torch.nn.functional.pad(mask, (1, 1, 1, 1)).flatten()
        column = (u * scale - (corner[0] - 1)).clamp(0, width + 1).long()
        row = (v * scale - (corner[1] - 1)).clamp(0, height + 1).long()
        return framed[row * (width + 2) + column] & (depth > 0)

    def may_meet(self, points: Tensor, reach: float) -> Tensor:
        """(P,) bool: can the mask meet the projection of a ball of radius `reach` about each (P, 3) point?

        The projection is replaced by a square of pixels that contains it, so the answer errs only towards True.
        """
        u, v, depth = (points @ self.px_from_world[:, :3].T + self.px_from_world[:, 3]).unbind(1)
        distance = torch.linalg.vector_norm(points - self.center, dim=1)
        scale = 1 / depth.clamp(min=1e-12)
        u, v = u * scale - self.corner[0], v * scale - self.corner[1]
        # |u' - u| <= f reach sqrt(1 + (X/Z)^2) / (Z - reach), and distance / depth bounds the root.
        margin = reach * self.focal / (depth - reach).clamp(min=1e-12) * distance * scale
        height, width = self.mask.shape
        integral = self.integral
        x1, y1 = ((c - margin).floor().clamp(0, side).long() for c, side in ((u, width), (v, height)))
        x2, y2 = (((c + margin).floor() + 1).clamp(0, side).long() for c, side in ((u, width), (v, height)))
        top, bottom = y1 * (width + 1), y2 * (width + 1)
        count = integral[bottom + x2] - integral[top + x2] - integral[bottom + x1] + integral[top + x1]
        # A ball that reaches behind the camera has no bounded projection. A mask point in it has a depth below
        # 2 reach, thus lies within 2 reach * slant of the camera, and the ball's centre within reach of that.
        beside = (depth > -reach) & (distance <= reach * (1 + 2 * self.slant))
        return torch.where(depth > reach, count > 0, beside)


def _share_of_masks(
    masks: list[_ViewMask], axes: list[Tensor], *, free: list[Tensor] | None, seen_share: float
) -> Tensor:
    """(X, Y, Z) float32: I_k (Eq. 6) on a grid, a slab at a time to bound the memory.

    With `free`, one map (H, W) bool per mask, it is 0 where not more than `seen_share` of the views whose pixel is in
    the mask or free have it in the mask.
    """
    slab = max(1, 2_000_000 // (len(axes[1]) * len(axes[2])))
    parts = []
    for planes in axes[0].split(slab):
        part = [planes, axes[1], axes[2]]
        votes = torch.zeros([len(axis) for axis in part], device=planes.device)
        for mask in masks:
            votes += mask.contains(part)
        share = votes / len(masks)
        if free is not None:
            empty = torch.zeros_like(votes)
            for mask, free_map in zip(masks, free, strict=True):
                empty += mask.look_up(part, free_map, (0, 0))
            share = share.where(votes > seen_share * (votes + empty) + 1e-6, 0)
        parts.append(share)
    return torch.cat(parts)


def _bounding_box(masks: list[_ViewMask], middle: Tensor, threshold: float) -> tuple[Tensor, Tensor] | None:
    """Corners (3,), (3,) of a box that holds every point whose share of masks exceeds the threshold.

    A cube about `middle` (3,), the point nearest to all centroid rays, twice as far as the farthest camera, is halved
    again and again; cells in which no point can exceed the threshold are discarded, until the box of the rest is
    `SEARCH_CELLS` cells long and hardly shrinks any more. Cells are judged by the balls around them, so nothing is
    lost, however thin. None when no cell is left. Masks of nearly parallel views may have no bounded common part: it is
    cut off at the cube.
    """
    centers = torch.stack([mask.center for mask in masks])
    half = 2 * float(torch.linalg.vector_norm(centers - middle, dim=1).max().clamp(min=1e-9))
    root_low, root_high = middle - half, middle + half
    cells, split = middle[None], torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3).to(middle)
    low, high, shrinks = root_low, root_high, True
    while (shrinks or (high - low).max() < 2 * half * SEARCH_CELLS) and len(cells) < MAX_CELLS:
        before = (high - low).prod()
        cells = (cells[:, None] + half * split).flatten(0, 1)
        half /= 2
        votes = torch.stack([mask.may_meet(cells, half * 3**0.5) for mask in masks]).sum(0)
        cells = cells[votes > threshold * len(masks) + 1e-6]
        if not len(cells):
            return None
        low, high = cells.amin(0) - half, cells.amax(0) + half
        shrinks = bool((high - low).prod() < 0.8 * before)
    if (low - half < root_low).any() or (high + half > root_high).any():
        message = f"the {len(masks)} masks of an instance have no bounded common part (the views are too similar)"
        warnings.warn(f"{message}: its shape is cut off", InputWarning, stacklevel=4)
    return low, high
