"""The paper's systems and ours behind one call: masks and scene in, instance ids out."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks.baselines.dense_points import DensePoints, sgbm_points
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

# row of the tables -> row of the paper that it is compared with
PRINTED = {
    "MVS-based": "MVS-based",
    "Point-based": "Point-based",
    "Sparse": "Sparse",
    "MVIS (paper)": "MVIS",
    "MVIS (one-per-view)": "MVIS",
    "MVIS (nview)": "MVIS",
}


def dense_points(cell: Cell, cache: Path) -> DensePoints:
    """The points of semi-global matching (the paper's PatchMatch needs a graphics card), cached beside the records."""
    origin = cell.folder.parents[1].name if cell.axes else "real"  # simulated scenes differ by size and seed
    path = cache / "points" / origin / f"{cell.name}.npy"
    if not path.is_file():
        positions = sgbm_points(cell.scene).positions.numpy()
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, positions)
    return DensePoints(torch.from_numpy(np.load(path)), "sgbm")


def mvs_matching(regions: Regions, cell: Cell, cache: Path) -> Matching:
    return match_mvs(regions, cell.scene, dense_points(cell, cache))


def point_matching(regions: Regions, cell: Cell, cache: Path) -> Matching:
    return match_points(regions, cell.scene)


def sparse_matching(regions: Regions, cell: Cell, cache: Path) -> Matching:
    return match_sparse(regions, cell.scene)


def mvis(method: Literal["symnmf", "one-per-view", "nview"]) -> Method:
    def match(regions: Regions, cell: Cell, cache: Path) -> Matching:
        return match_regions(regions, cell.scene.cameras, MatchConfig(method=method))

    return match


METHODS: dict[str, Method] = {
    "MVS-based": mvs_matching,
    "Point-based": point_matching,
    "Sparse": sparse_matching,
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
    start = time.perf_counter()
    try:
        matching = METHODS[method](masks.regions, cell, cache)
    except InputError as error:
        return {"na": str(error)}
    seconds = time.perf_counter() - start
    ids, judged = matching.instance_ids, masks.true_ids > 0
    metrics = matching_metrics(ids[judged], masks.true_ids[judged])
    # Eq. 8 counts an unmatched mask as right. An arg max over rows of zeros would put all of these into one cluster:
    together = matching_metrics(torch.where(ids < 0, len(ids) + 1, ids)[judged], masks.true_ids[judged])
    purity = {"s_match": metrics.s_match, "s_together": together.s_match}
    measures = {"e_k": metrics.e_k, "ari": metrics.ari, "f1": metrics.pair_f1}
    counts = {"masks": len(ids), "untied": int((ids < 0).sum()), "no_leaf": int((~judged).sum())}
    counts |= {"missed": masks.num_missed}
    return {**purity, **measures, **counts, "by": matching.report.method, "seconds": seconds}
