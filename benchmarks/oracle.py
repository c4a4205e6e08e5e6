"""Where is the limit of the N-view matcher? `python benchmarks/oracle.py --cache DIR [--leaves 16 32]`

On development plants with degraded masks (the scenes of benchmarks/matching.py): the answer found, the answer refined
from the true ids, and the true ids themselves, each with its ARI and with what the matcher thinks that it is worth. As
long as the truth is worth less than what is found, more search cannot help; only another objective can.
"""

from __future__ import annotations

import argparse
import multiprocessing
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matching import load_maps, true_ids

from mvseg.affinity import region_affinity
from mvseg.hypotheses import Costs, partition_value
from mvseg.metrics import matching_metrics
from mvseg.nview import refine, search, view_costs, weight_evidence
from mvseg.one_per_view import dense_ids, one_per_view_clusters
from mvseg.regions import regions_from_label_maps
from mvseg.rows import row_table
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_scenes


def judge_scene(spec: SceneSpec, cache: Path) -> tuple[int, int, list[float]]:
    """Leaves, views, and ARI and value of the answer found, refined from the truth, and of the truth."""
    torch.set_num_threads(1)
    true, degraded, cameras = load_maps(spec, cache)
    regions = regions_from_label_maps(list(degraded))
    truth = true_ids(regions, true)
    affinity, costs = region_affinity(regions, cameras), view_costs(len(cameras), Costs())
    W, table = affinity.to_dense().double().numpy(), row_table(regions, cameras)
    pairwise = one_per_view_clusters(affinity, regions.view_index, len(cameras)).numpy()
    alone = pairwise.max(initial=-1) + 1 + np.arange(len(pairwise))
    found = search(table, W, costs, dense_ids(np.where(pairwise >= 0, pairwise, alone)))
    refined = refine(table, W, dense_ids(truth.numpy()), costs, join_pieces=True)
    figures: list[float] = []
    for ids in (found, refined, dense_ids(truth.numpy())):
        ari = matching_metrics(torch.from_numpy(ids), truth).ari
        figures += [ari, partition_value(table, weight_evidence(W), ids, costs)]
    return spec.num_leaves, spec.num_views, figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for label maps")
    parser.add_argument("--leaves", nargs="+", type=int, default=(16, 32))
    args = parser.parse_args()
    every = list_scenes(PRESETS["paper-eval"], 0)
    scenes = [one for one in every if one.split == "dev" and one.num_leaves in args.leaves]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        rows = pool.map(partial(judge_scene, cache=args.cache), scenes, chunksize=1)
    print(f"{'leaves':>6}{'views':>6}{'found':>16}{'from the truth':>20}{'truth':>16}   (ARI, value)")
    for leaves, views in sorted({row[:2] for row in rows}):
        mean = np.mean([row[2] for row in rows if row[:2] == (leaves, views)], 0)
        cells = [f"{ari:10.3f} {value:8.1f}" for ari, value in zip(mean[::2], mean[1::2], strict=True)]
        print(f"{leaves:6}{views:6}" + "".join(cells))


if __name__ == "__main__":
    main()
