"""How far reconstructed points are from the true leaf meshes: d(I, T) of Sec. 4.3 and its two halves."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.paper_tables.cells import Cell, Record

Points = NDArray[np.float64]  # (P, 3)
Floats = NDArray[np.float64]

TRUE_SPACING = 0.01  # mean leaf lengths between neighbouring true points
MAX_QUERIES = 100_000  # of more points than this only every n-th is measured


@dataclass(frozen=True, eq=False)
class TrueLeaves:
    """(Q, 3) points on the true leaves, the same number per area, and the mean leaf length, in world units."""

    points: Points
    mean_length: float


@lru_cache(maxsize=2)
def true_leaves(cell: Cell) -> TrueLeaves:
    """The true leaves of a cell, from its meshes."""
    with open(cell.folder / "truth" / "traits.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    length = float(np.mean([float(row["length"]) for row in rows]))
    points = []
    for index, path in enumerate(sorted((cell.folder / "truth" / "leaves").glob("*.ply"))):
        mesh = trimesh.load_mesh(path, process=False)
        count = max(100, round(float(mesh.area) / (TRUE_SPACING * length) ** 2))
        points.append(np.asarray(trimesh.sample.sample_surface(mesh, count, seed=index)[0]))
    return TrueLeaves(np.concatenate(points), length)


def measure_points(points: Points, truth: TrueLeaves) -> Record:
    """d(I, T) and its two halves, in mean leaf lengths; see `measure_shares`."""
    return measure_shares(points, np.ones(len(points)), truth, thresholds=(0.5,))["0.5"]


def measure_shares(points: Points, shares: Floats, truth: TrueLeaves, *, thresholds: Iterable[float]) -> Record:
    """{"0.5": measures, ...}: d(I, T) of the points whose share exceeds a threshold.

    Args:
        points: (P, 3) candidates of the reconstruction.
        shares: (P,) their shares.
        truth: of the same scene.
        thresholds: one record each.

    Returns:
        Per threshold, in mean leaf lengths, "excess": mean distance from the reconstruction to the truth (matter where
        there is no leaf), "gaps": from the truth to the reconstruction (leaf where there is no matter), "d": their
        mean; and "points", their number. {"na": why} for a threshold without points.
    """
    length = truth.mean_length
    tried = np.arange(0, len(points), max(1, -(-len(points) // MAX_QUERIES)))
    excess = make_tree(truth.points).query(points[tried])[0] / length if len(tried) else np.zeros(0)
    record: Record = {}
    for threshold in thresholds:
        kept = shares > threshold + 1e-6
        if not kept[tried].any():
            record[f"{threshold:g}"] = {"na": "no point came out"}
            continue
        gaps = float(make_tree(points[kept]).query(truth.points)[0].mean()) / length
        extra = float(excess[kept[tried]].mean())
        record[f"{threshold:g}"] = {"d": (extra + gaps) / 2, "excess": extra, "gaps": gaps, "points": int(kept.sum())}
    return record


def make_tree(points: Points) -> cKDTree:
    """For nearest neighbours; with the options that are quick for points on a lattice."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def unite(shares: Iterable[tuple[Tensor, Tensor]], size: float) -> tuple[Points, Floats]:
    """The voxels of all leaves, each once.

    Args:
        shares: per leaf the centres of voxels (P, 3), all on one lattice, and their shares (P,).
        size: of the voxels, world units.

    Returns:
        (P, 3) centres, and (P,) the largest share that any leaf has there.
    """
    parts = list(shares)
    if not sum(len(points) for points, _ in parts):
        return np.zeros((0, 3)), np.zeros(0)
    index = np.concatenate([np.round(points.numpy() / size - 0.5).astype(np.int64) for points, _ in parts])
    low, shape = index.min(0), tuple(np.ptp(index, axis=0) + 1)
    keys, voxel = np.unique(np.ravel_multi_index(tuple((index - low).T), shape), return_inverse=True)
    best = np.zeros(len(keys))
    np.maximum.at(best, voxel, np.concatenate([share.double().numpy() for _, share in parts]))
    return (np.stack(np.unravel_index(keys, shape), 1) + low + 0.5) * size, best
