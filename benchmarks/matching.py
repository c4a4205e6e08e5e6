"""How well are regions matched? `python -m benchmarks.matching --cache ~/mvseg-cells [--split dev] [--methods ...]`

The scenes are those of `label_maps`. "true" masks are the visible parts of at least 30 pixels, "degraded" ones have the
faults of a segmenter. The split "dev" is for choosing parameters; look at "test" once, at the end. `--ablate` removes
one part of the N-view matcher at a time.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps
from benchmarks.thirds import changed
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import Affinity, region_affinity
from mvseg.matching.numbers import COSTS, GAINS, PIECES
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.symnmf import cluster_affinity
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.simulation.dataset import SceneSpec
from mvseg.system.worker_pool import run_all

Method = Callable[[Regions, Cameras, Affinity], torch.Tensor]


def symnmf_ids(regions: Regions, cameras: Cameras, affinity: Affinity) -> torch.Tensor:
    return cluster_affinity(affinity, regions.num_per_view).instance_ids


def one_per_view_ids(regions: Regions, cameras: Cameras, affinity: Affinity) -> torch.Tensor:
    return one_per_view_clusters(ViewGraph.of(affinity, regions)).drop_singletons().instance_ids()


def nview_ids(regions: Regions, cameras: Cameras, affinity: Affinity) -> torch.Tensor:
    return match_nview(regions, cameras, ViewGraph.of(affinity, regions)).instance_ids


def ablated_ids(
    regions: Regions, cameras: Cameras, affinity: Affinity, *, numbers: Any, values: Mapping[str, float]
) -> torch.Tensor:
    with changed(numbers, **values):
        return nview_ids(regions, cameras, affinity)


METHODS: dict[str, Method] = {"symnmf": symnmf_ids, "one-per-view": one_per_view_ids, "nview": nview_ids}
ABLATIONS: dict[str, tuple[Any, Mapping[str, float]]] = {
    "no weights": (GAINS, {"weight": 0}),
    "no coverage": (GAINS, {"coverage": 0}),
    "missed=absent": (COSTS, {"absent": COSTS.missing}),
    "hidden is free": (COSTS, {"hidden": 0}),
    "pieces alone": (PIECES, {"covered": math.inf}),
    "few views kept": (PIECES, {"few_covered": math.inf}),
}
METHODS |= {name: partial(ablated_ids, numbers=numbers, values=values) for name, (numbers, values) in ABLATIONS.items()}


def run_scene(spec: SceneSpec, *, cache: Path, methods: Iterable[str], kinds: Iterable[str]) -> list[dict[str, Any]]:
    """One record per kind of masks and method."""
    torch.set_num_threads(1)
    scene = load_maps(spec, cache)
    records = []
    for kind in kinds:
        regions, truth = scene.masks(kind)
        start = time.perf_counter()
        affinity = region_affinity(regions, scene.cameras)
        affinity_s = time.perf_counter() - start
        for method in methods:
            start = time.perf_counter()
            ids = METHODS[method](regions, scene.cameras, affinity)
            seconds = time.perf_counter() - start + affinity_s
            metrics = matching_metrics(ids, truth)
            measures = {"ari": metrics.ari, "e_k": metrics.e_k, "s_match": metrics.s_match, "f1": metrics.pair_f1}
            cell = {"leaves": spec.num_leaves, "views": spec.num_views, "family": spec.family, "scene": spec.folder}
            records.append({"method": method, "masks": kind, **cell, "seconds": seconds, **measures})
    return records


def print_tables(records: list[dict[str, Any]]) -> None:
    """Per method and kind of masks, averages over the cells, one row per measure."""
    keys = sorted({(r["masks"], r["method"]) for r in records}, reverse=True)
    columns = [("views", n) for n in (20, 10, 5, 3)] + [("leaves", n) for n in (32, 16, 8, 4)]
    print(f"{'masks':9}{'method':16}{'':8}" + "".join(f"{n:>6} {axis[0]}" for axis, n in columns) + "     all")
    for masks, method in keys:
        rows = [r for r in records if r["masks"] == masks and r["method"] == method]
        for measure in ("ari", "e_k", "s_match", "f1", "seconds"):
            cells = [[r[measure] for r in rows if r[axis] == n] for axis, n in columns] + [[r[measure] for r in rows]]
            figures = "".join(f"{np.mean(cell):8.3f}" if cell else "       -" for cell in cells)
            print(f"{masks:9}{method:16}{measure:8}{figures}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=["symnmf", "one-per-view", "nview"])
    parser.add_argument("--ablate", action="store_true", help="one-per-view, nview, and nview minus one part at a time")
    parser.add_argument("--masks", nargs="+", choices=KINDS, default=KINDS)
    args = parser.parse_args()
    methods = ["one-per-view", "nview", *ABLATIONS] if args.ablate else args.methods
    work = partial(run_scene, cache=args.cache, methods=methods, kinds=args.masks)
    records = [record for of_scene in run_all(work, chosen_scenes(args), args.workers) for record in of_scene]
    print_tables(records)


if __name__ == "__main__":
    main()
