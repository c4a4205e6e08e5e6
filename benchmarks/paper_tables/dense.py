"""Dense points of a scene by stereo on the CPU, cached beside the records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from benchmarks.baselines.dense_points import DensePoints, sgbm_points
from benchmarks.paper_tables.cells import Cell
from mvseg.system.atomic import write_whole


def dense_points(cell: Cell, cache: Path) -> DensePoints:
    """The points of semi-global matching (backend "sgbm"; the paper's PatchMatch needs a graphics card)."""
    origin = cell.folder.parents[1].name if cell.axes else "real"  # simulated scenes differ by size and seed
    path = cache / "points" / origin / f"{cell.name}.npy"
    if not path.is_file():
        positions = sgbm_points(cell.scene).positions.numpy()
        path.parent.mkdir(parents=True, exist_ok=True)

        def save(partial: Path) -> None:
            with partial.open("wb") as file:
                np.save(file, positions)

        write_whole(path, save)
    return DensePoints(torch.from_numpy(np.load(path)), "sgbm")
