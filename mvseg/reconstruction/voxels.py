"""Back-projection of each instance into voxels (Eq. 6), and their points and mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from mvseg.errors import InputError, check_arguments, warn
from mvseg.findings.finding import Finding
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.numbers import VOXELS
from mvseg.reconstruction.visual_hull import Silhouettes, halve_cells
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """One instance in 3D.

    Attributes:
        origin: (3,) float64, world position of the corner of voxel (0, 0, 0); voxel (a, b, c) is centred at origin +
            voxel_size * (a + 0.5, b + 0.5, c + 0.5).
        voxel_size: edge length in world units.
        votes: (X, Y, Z) float32 in [0, 1]: share of the instance's views whose mask contains the centre (I_k, Eq. 6); 0
            where `ReconstructConfig.seen_share` forbids the voxel, and in crumbs that were dropped.
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
        """Number of pieces of the occupied voxels. Voxels of one piece share faces; an edge or a corner does not do: in
        the mesh such voxels come apart, as a rule."""
        return len(self._pieces()[1])

    def without_crumbs(self) -> VoxelGrid:
        """The grid without pieces that have fewer voxels than `VOXELS.crumb` of the largest one: their votes become 0,
        so that they are gone from points, volume and mesh alike."""
        piece, sizes = self._pieces()
        if not len(sizes) or sizes.min() >= VOXELS.crumb * sizes.max():
            return self
        is_crumb = np.append(False, sizes < VOXELS.crumb * sizes.max())[piece]
        return replace(self, votes=self.votes.masked_fill(torch.from_numpy(is_crumb).to(self.votes.device), 0))

    def _pieces(self) -> tuple[np.ndarray, np.ndarray]:
        """(X, Y, Z) piece of each voxel, from 1 on, 0 where it is free; (pieces,) their numbers of voxels."""
        piece, _ = ndimage.label(self.occupied.cpu().numpy())
        return piece, np.bincount(piece.ravel())[1:]

    def mesh(self) -> trimesh.Trimesh:
        """Closed surface of the occupied voxels (marching cubes between the last free and the first occupied share).
        World coordinates, faces outward; an empty mesh when no voxel is occupied."""
        if not self.occupied.any():
            return trimesh.Trimesh()
        votes = np.pad(self.votes.cpu().numpy(), 1)
        level = (np.floor(self.threshold * self.num_views + 1e-6) + 0.5) / self.num_views
        vertices, faces, _, _ = marching_cubes(votes, level, gradient_direction="ascent")
        world = self.origin.cpu().numpy() + self.voxel_size * (vertices - 0.5)
        return trimesh.Trimesh(world, faces, process=False)


@check_arguments
def reconstruct_instances(
    regions: Regions, instance_ids: Tensor, cameras: Cameras, *, config: ReconstructConfig = ReconstructConfig()
) -> dict[int, VoxelGrid]:
    """Back-project every instance that is seen in at least two views.

    Departs from the paper by `config.seen_share`, which brings shapes closer to the true leaves (docs/benchmarks.md).

    Args:
        instance_ids: (D,) int64, from 1 on; -1 = matched to nothing.

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
        free = {view: regions.label_map(view, ones, size) == 0 for view, size in enumerate(cameras.sizes.tolist())}
    instances = instance_ids[instance_ids > 0].unique().tolist()
    for instance in progress_bar(instances, name="voxels", unit="instance"):
        members = regions.select(instance_ids == instance)
        grid = back_project(members, cameras, config=config, free=free)
        if grid is not None and grid.occupied.any():
            shapes[instance] = grid
        elif len(members.view_index.unique()) > 1:
            warn(Finding("no_shape", values={"instance": instance, "count": len(members)}))
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
        free: view -> (H, W) bool, where it shows no region of any instance, for `config.seen_share`; of every view with
            a mask. None: no pixel is known to be free, which leaves the paper's rule.

    Returns:
        The grid, or None for an instance seen in fewer than two views or without a common point. Warns (InputWarning)
        when the common part is unbounded, as with nearly parallel views, and had to be cut off.

    Raises:
        InputError: a voxel size that asks for more than 2e8 voxels.
    """
    cameras = cameras.to(members.device)
    views = members.view_index[members.areas > 0].unique().tolist()
    if len(views) < 2:
        return None
    crops = [members.union((members.view_index == view).nonzero()[:, 0].tolist()) for view in views]
    corners = torch.tensor([crop.box[:2] for crop in crops]).to(cameras.K)
    matrices = cameras.px_from_world[views]
    silhouettes = Silhouettes(
        masks=tuple(crop.pixels for crop in crops),
        px_from_world=torch.cat((matrices[:, :2] - corners[..., None] * matrices[:, 2:], matrices[:, 2:]), 1),
    )
    if (box := _bounding_box(silhouettes, config.threshold)) is None:
        return None
    low, high = box
    size = config.voxel_size or float(((high - low).prod() / config.voxel_budget) ** (1 / 3))
    first, last = (low / size).floor(), (high / size).ceil()
    shape = (last - first).long().clamp(min=1)
    if float((last - first).prod()) > VOXELS.max_voxels:
        asked = int((last - first).prod())
        raise InputError(f"a voxel size of {size:g} asks for {asked} voxels, expected at most {VOXELS.max_voxels}")
    axes = [(first[a] + 0.5 + torch.arange(int(shape[a])).to(low)) * size for a in range(3)]
    frames = None if free is None else Silhouettes(tuple(free[view].to(members.device) for view in views), matrices)
    votes = _share_of_masks(silhouettes, axes, free=frames, seen_share=config.seen_share)
    return VoxelGrid(
        origin=first * size, voxel_size=size, votes=votes, num_views=len(views), threshold=config.threshold
    )


def _share_of_masks(
    silhouettes: Silhouettes, axes: list[Tensor], *, free: Silhouettes | None, seen_share: float
) -> Tensor:
    """(X, Y, Z) float32: I_k (Eq. 6), slab by slab; 0 where masks are at most `seen_share` of masks and `free`."""
    slab = max(1, VOXELS.slab // (len(axes[1]) * len(axes[2])))
    parts = []
    for planes in axes[0].split(slab):
        part = [planes, axes[1], axes[2]]
        votes = _count_masks(silhouettes, part)
        share = votes / len(silhouettes)
        if free is not None:
            share = share.where(votes > seen_share * (votes + _count_masks(free, part)) + 1e-6, 0)
        parts.append(share)
    return torch.cat(parts)


def _count_masks(silhouettes: Silhouettes, axes: list[Tensor]) -> Tensor:
    """(X, Y, Z) float32: how many masks the points of a grid are in, L of Eq. 6 summed over the views."""
    count = torch.zeros([len(axis) for axis in axes], device=axes[0].device)
    for mask, px_from_world in zip(silhouettes.masks, silhouettes.px_from_world, strict=True):
        count += _is_in(mask, px_from_world, axes)
    return count


def _is_in(mask: Tensor, px_from_world: Tensor, axes: list[Tensor]) -> Tensor:
    """(X, Y, Z) bool, L of Eq. 6: is the point in front of the camera, and its pixel in the mask (h, w)?"""
    first = torch.stack([axis[0] for axis in axes])
    offset = (px_from_world[:, :3] @ first + px_from_world[:, 3]).float()
    x, y, z = ((axis - axis[0]).float() for axis in axes)
    x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
    rows = px_from_world.float()
    u, v, depth = (row[0] * x + row[1] * y + (row[2] * z + start) for row, start in zip(rows, offset, strict=True))
    scale = 1 / depth.clamp(min=1e-12)
    height, width = mask.shape
    # A border of one False pixel receives everything that falls outside.
    framed = torch.nn.functional.pad(mask, (1, 1, 1, 1)).flatten()
    column, row = (u * scale + 1).clamp(0, width + 1).long(), (v * scale + 1).clamp(0, height + 1).long()
    return framed[row * (width + 2) + column] & (depth > 0)


def _bounding_box(silhouettes: Silhouettes, threshold: float) -> tuple[Tensor, Tensor] | None:
    """Corners (3,), (3,) of a box of all points whose share of masks exceeds the threshold; None without any."""
    before = torch.inf
    for cells in halve_cells(silhouettes, threshold):
        if not len(cells):
            return None
        low, high = cells.box
        volume = float((high - low).prod())
        is_fine = float((high - low).max()) >= VOXELS.search_cells * cells.size and volume >= VOXELS.shrinks * before
        if is_fine or len(cells) >= VOXELS.max_cells:
            break
        before = volume
    root_low, root_high = silhouettes.cube.box
    if (low - cells.size / 2 < root_low).any() or (high + cells.size / 2 > root_high).any():
        warn(Finding("shape_cut_off", values={"count": len(silhouettes)}))
    return low, high
