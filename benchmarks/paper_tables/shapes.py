"""Table 3: reconstructions from different masks and ids, and by different rules."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.mvs import MVS
from benchmarks.paper_tables.cells import Cell, Record
from benchmarks.paper_tables.masks import Masks
from benchmarks.paper_tables.methods import dense_points
from benchmarks.paper_tables.shape_error import measure_points, measure_shares, true_leaves, unite
from mvseg.errors import InputError, InputWarning
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.voxels import VoxelGrid, back_project, reconstruct_instances

VOXELS_PER_LEAF = 50  # along the mean length of a leaf
PAPER_THRESHOLD = 0.5
THRESHOLDS = (0.5, 0.7, 0.8, 0.9)
DEFAULT_SHARE = f"{ReconstructConfig.seen_share:g}"  # one of these

Masked = Callable[[str], Masks]  # the masks of a cell by kind
Shape = Callable[[Cell, Masked, Path], Record]
Rule = Callable[[Cell, Masks, Tensor], Record]


@lru_cache(maxsize=100)
def carve(cell: Cell, masks: Masks, members: tuple[int, ...], *, threshold: float, size: float) -> VoxelGrid | None:
    """The voxels of one instance (see `back_project`); cached, because the methods agree on most instances.

    Args:
        cell: gives the cameras.
        masks: of the cell.
        members: indices of the instance's masks.
        threshold: share of the masks that a voxel needs.
        size: of the voxels, world units.
    """
    regions = masks.regions.select(torch.tensor(members))
    with warnings.catch_warnings():  # an instance without a shape is part of the measured error
        warnings.simplefilter("ignore", InputWarning)
        return back_project(regions, cell.scene.cameras, config=ReconstructConfig(threshold=threshold, voxel_size=size))


def measure_thresholds(cell: Cell, masks: Masks, ids: Tensor) -> Record:
    """{"0.5": measures, ...}: d of the shapes of all instances (D,), by the share of masks that a voxel needs."""
    truth = true_leaves(cell)
    size = truth.mean_length / VOXELS_PER_LEAF
    instances = [tuple((ids == i).nonzero()[:, 0].tolist()) for i in ids[ids > 0].unique().tolist()]
    grids = [carve(cell, masks, members, threshold=min(THRESHOLDS), size=size) for members in instances]
    shares = [(grid.points, grid.votes[grid.occupied]) for grid in grids if grid is not None]
    return {"shapes": len(shares)} | measure_shares(*unite(shares, size), truth, thresholds=THRESHOLDS)


def measure_hidden(cell: Cell, masks: Masks, ids: Tensor) -> Record:
    """{"0.5": measures, ...} by the rule for hidden parts, `ReconstructConfig.seen_share`, with the paper's 0.5."""
    truth = true_leaves(cell)
    size = truth.mean_length / VOXELS_PER_LEAF
    record: Record = {}
    for share in THRESHOLDS:
        config = ReconstructConfig(threshold=PAPER_THRESHOLD, seen_share=share, voxel_size=size)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            grids = reconstruct_instances(masks.regions, ids, cell.scene.cameras, config=config).values()
        points = unite([(grid.points, torch.ones(int(grid.occupied.sum()))) for grid in grids], size)[0]
        record[f"{share:g}"] = measure_points(points, truth)
    return {"shapes": len(grids)} | record


def is_in_mask(cell: Cell, masks: Masks, points: Tensor) -> Iterator[Tensor]:
    """Per view (P,) bool: does the point project into any mask?"""
    ones = torch.ones(len(masks.regions), dtype=torch.int64)
    sizes = cell.scene.cameras.sizes.tolist()
    for view, (px, z) in enumerate(zip(*cell.scene.cameras.project(points), strict=True)):
        width, height = sizes[view]
        covered = masks.regions.label_map(view, ones, (width, height)) > 0
        column, row = px.nan_to_num(-1, -1, -1).floor().clamp(-1, max(height, width)).long().unbind(1)
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        yield inside & covered[row.clamp(0, height - 1), column.clamp(0, width - 1)]


def measure_shape(cell: Cell, masks: Masked, name: str, *, cache: Path) -> Record:
    """The record of one entry of `SHAPES`; {"na": why} where nothing can be reconstructed."""
    try:
        return SHAPES[name](cell, masks, cache)
    except InputError as error:
        return {"na": str(error)}


def dense(cell: Cell, masks: Masked, cache: Path) -> Record:
    """All points of stereo: on leaves, stems, pot and ground."""
    return {"by": MVS, "0.5": measure_points(dense_points(cell, cache).numpy(), true_leaves(cell))}


def dense_on_leaves(cell: Cell, masks: Masked, cache: Path) -> Record:
    """The points of stereo that lie in some true mask of more than half of the views."""
    points = dense_points(cell, cache)
    shares = torch.stack(list(is_in_mask(cell, masks("true"), points))).double().mean(0)
    return {"by": MVS, "0.5": measure_points(points[shares > PAPER_THRESHOLD].numpy(), true_leaves(cell))}


def semantic(kind: str) -> Shape:
    """The "silhouettes of all leaves" of Sec. 4.3; voxels twice as large as for single leaves: there are many more."""

    def measure(cell: Cell, masks: Masked, cache: Path) -> Record:
        truth = true_leaves(cell)
        config = ReconstructConfig(threshold=PAPER_THRESHOLD, voxel_size=2 * truth.mean_length / VOXELS_PER_LEAF)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            grid = back_project(masks(kind).regions, cell.scene.cameras, config=config)
        points = np.zeros((0, 3)) if grid is None else grid.points.numpy()
        return {"0.5": measure_points(points, truth)}

    return measure


def matched(kind: str, method: Literal["symnmf", "nview"], rule: Rule = measure_thresholds) -> Shape:
    """Estimated ids, and the paper's rule or that for hidden parts."""

    def measure(cell: Cell, masks: Masked, cache: Path) -> Record:
        of_kind = masks(kind)
        return rule(cell, of_kind, estimate(cell, of_kind, method))

    return measure


@lru_cache(maxsize=8)
def estimate(cell: Cell, masks: Masks, method: Literal["symnmf", "nview"]) -> Tensor:
    """(D,) instance ids."""
    return match_regions(masks.regions, cell.scene.cameras, MatchConfig(method=method)).instance_ids


SHAPES: dict[str, Shape] = {
    "MVS points": dense,
    "MVS points on leaves": dense_on_leaves,
    "semantic segmentation, true masks": semantic("true"),
    "semantic segmentation, degraded masks": semantic("degraded"),
    "MVIS (paper), true masks": matched("true", "symnmf"),
    "MVIS (nview), true masks": matched("true", "nview"),
    "MVIS (nview), true masks, hidden parts": matched("true", "nview", measure_hidden),
    "MVIS (paper), degraded masks": matched("degraded", "symnmf"),
    "MVIS (nview), degraded masks": matched("degraded", "nview"),
    "MVIS (nview), degraded masks, hidden parts": matched("degraded", "nview", measure_hidden),
}
