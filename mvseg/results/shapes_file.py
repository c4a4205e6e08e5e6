"""Shapes as arrays: surfaces.npz and voxels.npz hold them exactly, for programs that read a result.

Nothing is pickled. Arrays of several leaves are stacked in the order of their ids; arrays of other lengths for each
leaf stand one after another, and an array `num_...` holds these lengths.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.reconstruction.numbers import OCCUPANCY
from mvseg.reconstruction.surface.leaf_patch import NUM_COEFFICIENTS
from mvseg.reconstruction.surface.leaf_surface import ByInstance, LeafSurface, Occupancy
from mvseg.reconstruction.voxels import VoxelGrid

SURFACES_FILE, VOXELS_FILE = "surfaces.npz", "voxels.npz"
TENSORS = ("coefficients", "covariance", "views", "residual_px", "iou")  # of a `LeafSurface`


def write_surfaces(path: Path, surfaces: Mapping[int, LeafSurface]) -> None:
    """Write surfaces, those that are not credible or do not exist (NaN) included; `read_surfaces` gives them back.

    Arrays of N leaves: `leaf` (N,) int64, their ids; `coefficients` (N, 26, 3) and `covariance` (N, 78, 78) float64,
    `is_oriented` (N,) bool, see `LeafSurface`; `num_views` (N,) int64, and one after another `views` int64,
    `residual_px` and `iou` float64; of those M leaves that have an `occupancy`: `occupied` (M,) int64, their places,
    `shares` (M, `OCCUPANCY.cells`) float32 and `area` (M, 2) float64, with its deviation; `num_reasons` (N,) int64, and
    one after another `reasons`, text, and their codes.
    """
    leaves = sorted(surfaces)
    own = [surfaces[leaf] for leaf in leaves]
    reasons = [each.reasons for each in own]
    occupied = {place: each.occupancy for place, each in enumerate(own) if each.occupancy is not None}
    np.savez_compressed(
        path,
        leaf=np.array(leaves, np.int64),
        coefficients=_stack((each.coefficients for each in own), (NUM_COEFFICIENTS, 3)),
        covariance=_stack((each.covariance for each in own), (3 * NUM_COEFFICIENTS,) * 2),
        is_oriented=np.array([each.is_oriented for each in own], bool),
        num_views=np.array([len(each.views) for each in own], np.int64),
        views=np.concatenate([np.zeros(0, np.int64), *(each.views.cpu().numpy() for each in own)]),
        residual_px=np.concatenate([np.zeros(0), *(each.residual_px.cpu().numpy() for each in own)]),
        iou=np.concatenate([np.zeros(0), *(each.iou.cpu().numpy() for each in own)]),
        occupied=np.array([*occupied], np.int64),
        shares=_stack((each.shares for each in occupied.values()), OCCUPANCY.cells).astype(np.float32),
        area=np.array([(each.area, each.sd) for each in occupied.values()], np.float64).reshape(-1, 2),
        num_reasons=np.array([len(each) for each in reasons], np.int64),
        reasons=np.array([text for each in reasons for text in each.values()], np.str_),
        codes=np.array([code for each in reasons for code in each], np.str_),
    )


def read_surfaces(path: Path) -> dict[int, LeafSurface]:
    """{instance id: surface} of a file that `write_surfaces` wrote. Raises InputError: it is none; or coefficients are
    no numbers, and no reason says why there is no surface."""
    arrays = _read(path)
    try:
        views, residuals, ious = (_split(arrays[name], arrays["num_views"]) for name in ("views", "residual_px", "iou"))
        texts = arrays["reasons"]
        both = texts, arrays.get("codes", texts)  # an older version has no codes
        reasons, names = (_split(each, arrays["num_reasons"]) for each in both)
        coefficients = arrays["coefficients"].reshape(-1, NUM_COEFFICIENTS, 3)
        covariance = arrays["covariance"].reshape(-1, *(3 * NUM_COEFFICIENTS,) * 2)
        rows = arrays["leaf"], arrays["is_oriented"], reasons, names, coefficients, covariance, views, residuals, ious
        surfaces = {}
        for leaf, is_oriented, doubts, codes, *own in zip(*rows, strict=True):
            tensors: dict[str, Any] = dict(zip(TENSORS, (torch.from_numpy(each.copy()) for each in own), strict=True))
            why = dict(zip(codes.tolist(), doubts.tolist(), strict=True))
            surface = LeafSurface(**tensors, is_oriented=bool(is_oriented), reasons=why)
            if not surface.exists and (surface.coefficients.isfinite().any() or not surface.reasons):
                raise ValueError(f"leaf {leaf} has coefficients that are not finite")
            surfaces[int(leaf)] = surface
        occupied = (arrays.get(name, ()) for name in ("occupied", "shares", "area"))  # an older version has none
        for place, shares, (area, sd) in zip(*occupied, strict=True):
            leaf = int(arrays["leaf"][place])
            occupancy = Occupancy(torch.from_numpy(shares.reshape(OCCUPANCY.cells).copy()), float(area), float(sd))
            surfaces[leaf] = replace(surfaces[leaf], occupancy=occupancy)
        return ByInstance(surfaces)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no surfaces that mvseg wrote ({error})") from None


def write_voxels(path: Path, voxels: Mapping[int, VoxelGrid]) -> None:
    """Write voxels, see `VoxelGrid`; `read_voxels` gives them back. Arrays of N leaves: `leaf`, `num_views` (N,) int64,
    `origin` (N, 3), `voxel_size`, `threshold` (N,) float64; and `votes_K` (X, Y, Z) float32 of leaf K."""
    leaves = sorted(voxels)
    own = [voxels[leaf] for leaf in leaves]
    votes: dict[str, Any] = {f"votes_{leaf}": voxels[leaf].votes.cpu().numpy() for leaf in leaves}
    np.savez_compressed(
        path,
        leaf=np.array(leaves, np.int64),
        num_views=np.array([each.num_views for each in own], np.int64),
        origin=_stack((each.origin for each in own), (3,)),
        voxel_size=np.array([each.voxel_size for each in own], np.float64),
        threshold=np.array([each.threshold for each in own], np.float64),
        **votes,
    )


def read_voxels(path: Path) -> dict[int, VoxelGrid]:
    """{instance id: voxels} of a file that `write_voxels` wrote. Raises InputError: it is none."""
    arrays = _read(path)
    try:
        if not (np.isfinite(arrays["origin"]).all() and np.isfinite(arrays["voxel_size"]).all()):
            raise ValueError("a grid lies at no place")
        grids, columns = {}, [arrays[name] for name in ("leaf", "origin", "voxel_size", "num_views", "threshold")]
        for leaf, origin, size, num_views, threshold in zip(*columns, strict=True):
            corner, votes = torch.from_numpy(origin.copy()), torch.from_numpy(arrays[f"votes_{leaf}"])
            grids[int(leaf)] = VoxelGrid(corner, float(size), votes, int(num_views), float(threshold))
        return ByInstance(grids)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no voxels that mvseg wrote ({error})") from None


def _stack(tensors: Iterable[torch.Tensor], shape: Sequence[int]) -> NDArray[np.float64]:
    return np.array([each.cpu().numpy() for each in tensors], np.float64).reshape(-1, *shape)


def _split(values: NDArray[Any], counts: NDArray[np.int64]) -> list[NDArray[Any]]:
    if counts.sum() != len(values):
        raise ValueError(f"{len(values)} numbers, expected {counts.sum()}")
    return np.split(values, counts.cumsum()[:-1]) if len(counts) else []


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds at broken files
        raise InputError(f"{path}: is no NumPy archive that mvseg wrote ({' '.join(str(error).split())})") from None
