"""Where on a sheet its leaf is: leaves with lobes, leaflets or holes, whose outline no patch follows.

A patch is a smooth sheet. Each view that sees a cell of it openly votes whether leaf is there. Votes are weighted by
the cosine between ray and normal: so views from all around see as much of a part of the leaf that lies beside the
sheet, or is turned against it, as they would of one in the sheet (Cauchy's projection formula). Votes err; the
occupancy of a cell is the probability that it is leaf, and the area is the integral of that over the sheet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import DOUBTS, OCCUPANCY
from mvseg.reconstruction.surface.leaf_patch import patch_grid
from mvseg.reconstruction.surface.leaf_surface import LeafSurface, Occupancy, cell_normals
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.patch_image import crop_ious, draw_polygons, grid_quads, project_points


def occupy_surface(surface: LeafSurface, masks: MaskStack, *, hidden: MaskStack, unshown: float) -> LeafSurface:
    """The surface with its occupancy where that explains the masks clearly better than the whole patch; or as it is.

    Args:
        masks: of the leaf; any pixel of another instance may hide the leaf.
        hidden: the same with the pixels that do hide it, as the surfaces of the others have it.
        unshown: `unshown_share` of the surface.
    """
    if float(surface.iou.median()) >= OCCUPANCY.explained and unshown <= DOUBTS.most_unshown:
        return surface
    points = patch_grid(*(count + 1 for count in OCCUPANCY.cells)).points(surface.coefficients.numpy())
    occupancy = measure_occupancy(masks, points, sheet_sd=surface.deviations[0] / surface.area)
    iou = torch.from_numpy(crop_ious(hidden, _cover(hidden, points, occupancy.is_leaf)))
    gain = float(iou.median() - surface.iou.median())
    return replace(surface, iou=iou, occupancy=occupancy) if gain >= OCCUPANCY.least_gain else surface


def unshown_share(masks: MaskStack, points: Floats) -> float:
    """Share of a sheet, by grid points (rows, columns, 3), that at most `vote_error` of its open views show."""
    areas, votes = np.linalg.norm(cell_normals(points), axis=-1), _votes(masks, masks.inside, _centres(points))
    shown = (votes > 0).sum(0) / np.maximum((votes != 0).sum(0), 1)
    return float(areas[shown < OCCUPANCY.vote_error].sum() / areas.sum())


def measure_occupancy(masks: MaskStack, points: Floats, *, sheet_sd: float = 0.0) -> Occupancy:
    """Occupancy of a sheet.

    Its deviation adds what the area changes without each view in turn (jackknife), with outlines of masks that are off
    by `OCCUPANCY.edge_px` in all photos, and a share of the sheet's own.

    Args:
        points: (rows, columns, 3) grid points of the sheet.
        sheet_sd: standard deviation of the area of the whole sheet, as a share of it.
    """
    normals = cell_normals(points)
    areas = np.linalg.norm(normals, axis=-1)
    odds = _log_odds(masks, masks.inside, points, normals)
    shares = expit(odds.sum(0))
    area = float((areas * shares).sum())
    without = np.array([(areas * expit(odds.sum(0) - of_view)).sum() for of_view in odds])
    grown, shrunk = (
        (areas * expit(_log_odds(masks, inside, points, normals).sum(0))).sum()
        for inside in (masks.depth_px > -1, masks.depth_px >= 1)
    )
    deviations = (
        np.sqrt((len(odds) - 1) * without.var()),
        OCCUPANCY.edge_px / masks.pixel_size * (grown - shrunk) / 2,
        OCCUPANCY.sheet_share * sheet_sd * area,
    )
    return Occupancy(torch.from_numpy(shares.astype(np.float32)), area, float(np.linalg.norm(deviations)))


def _centres(points: Floats) -> Floats:
    """(rows - 1, columns - 1, 3) of the cells."""
    return (points[1:, 1:] + points[1:, :-1] + points[:-1, 1:] + points[:-1, :-1]) / 4


def _votes(masks: MaskStack, inside: NDArray[np.bool_], centres: Floats) -> NDArray[np.int64]:
    """(S, rows, columns) 1 where a view shows leaf at a cell, -1 where it does not, 0 where something may hide it."""
    px = project_points(masks.px_from_world, centres).px.reshape(-1, 2)
    stack = np.arange(len(masks)).repeat(centres[..., 0].size)
    votes = np.where(masks.look_up(inside, stack, px), 1, -1) * (masks.look_up(masks.others, stack, px) == 0)
    return votes.reshape(len(masks), *centres.shape[:2])


def _log_odds(masks: MaskStack, inside: NDArray[np.bool_], points: Floats, normals: Floats) -> Floats:
    """(S, rows - 1, columns - 1) log odds for leaf that each view gives each cell."""
    centres, matrices = _centres(points), masks.px_from_world
    cameras = -np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[:, None, None, :, 0]
    rays = centres - cameras
    lengths = np.linalg.norm(rays, axis=-1) * np.maximum(np.linalg.norm(normals, axis=-1), 1e-300)
    cosines = np.abs((rays * normals).sum(-1)) / lengths
    return np.asarray(np.log(1 / OCCUPANCY.vote_error - 1) * cosines * _votes(masks, inside, centres))


def _cover(masks: MaskStack, points: Floats, is_leaf: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(S, H, W) pixels that the cells with leaf, of the sheet of grid points (rows, columns, 3), cover."""
    corner, (height, width) = np.zeros(2), masks.size
    images = (grid_quads(px)[is_leaf.ravel()] for px in project_points(masks.px_from_world, points).px)
    return np.array([draw_polygons(quads, (width, height), corner) >= 0.5 for quads in images])
