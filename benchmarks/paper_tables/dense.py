"""Dense points of a scene by stereo on the CPU, kept beside the records."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper_tables.cells import Cell
from mvseg.baselines.dense_points import DensePoints, sgbm_points


def dense_points(cell: Cell, cache: Path) -> DensePoints:
    """The points of semi-global matching (back end "sgbm"; the paper's PatchMatch needs a graphics card)."""
    place = cell.folder.parents[1].name if cell.axes else "real"  # simulated scenes differ by size and seed
    path = cache / "points" / place / f"{cell.name}.npy"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(f".{os.getpid()}.npy")
        np.save(unfinished, sgbm_points(cell.scene).positions.numpy())
        os.replace(unfinished, path)
    return DensePoints(torch.from_numpy(np.load(path)), "sgbm")
