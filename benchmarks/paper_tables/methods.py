"""The paper's systems and ours behind one call: masks and scene in, instance ids out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.dense_points import sgbm_points
from benchmarks.baselines.mvs import match_mvs
from benchmarks.baselines.points import match_points
from benchmarks.baselines.sparse import match_sparse
from benchmarks.paper_tables.cells import Cell, Record
from benchmarks.paper_tables.masks import Masks
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.regions import Regions

Method = Callable[[Regions, Cell, Path], Matching]


def dense_points(cell: Cell, cache: Path) -> Tensor:
    """(P, 3) points of semi-global matching (PatchMatch needs a graphics card), cached beside the records."""
    origin = cell.folder.parents[1].name if cell.axes else "real"  # simulated scenes differ by size and seed
    path = cache / "points" / origin / f"{cell.name}.npy"
    if not path.is_file():
        positions = sgbm_points(cell.scene).numpy()
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, positions)
    return torch.from_numpy(np.load(path))


def mvis(method: Literal["symnmf", "one-per-view", "nview"]) -> Method:
    def match(regions: Regions, cell: Cell, cache: Path) -> Matching:
        return match_regions(regions, cell.scene.cameras, MatchConfig(method=method))

    return match


METHODS: dict[str, Method] = {
    "MVS-based": lambda regions, cell, cache: match_mvs(regions, cell.scene, dense_points(cell, cache)),
    "Point-based": lambda regions, cell, _: match_points(regions, cell.scene),
    "Sparse": lambda regions, cell, _: match_sparse(regions, cell.scene),
    "MVIS (paper)": mvis("symnmf"),
    "MVIS (one-per-view)": mvis("one-per-view"),
    "MVIS (nview)": mvis("nview"),
}


def score_method(cell: Cell, masks: Masks, method: str, *, cache: Path) -> Record:
    """Match the masks of a cell and compare with the truth.

    Masks that show no leaf are matched with the others, but not scored.

    Returns:
        The measures; {"na": why} alone where the method has no answer.
    """
    try:
        matching = METHODS[method](masks.regions, cell, cache)
    except InputError as error:
        return {"na": str(error)}
    ids, judged = matching.instance_ids, masks.true_ids > 0
    metrics = matching_metrics(ids[judged], masks.true_ids[judged])
    measures = {"s_match": metrics.s_match, "e_k": metrics.e_k, "ari": metrics.ari}
    counts = {"masks": len(ids), "no_leaf": int((~judged).sum()), "missed": masks.num_missed}
    return {**measures, **counts, "by": matching.report.method}
