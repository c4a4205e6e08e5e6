"""Where is the limit of the N-view matcher? `python benchmarks/oracle.py --cache DIR [--leaves 16 32]`

On development plants (like those of benchmarks/matching.py): the answer found; the one that much more search finds,
from eight starts and by set packing (the best disjoint ones of all clusters ever seen, by an integer programme); the
one refined from the true ids; and the true ids themselves. Each with its ARI and with what the matcher thinks that it
is worth. As long as the truth is worth less than what is found, more search cannot help; only another objective can.
"""

from __future__ import annotations

import argparse
import multiprocessing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csc_array

from matching import load_maps
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.cluster_scores import Costs, nothing_known, own_scores, partition_value
from mvseg.matching.nview.label_rows import RowTable, em_affinities, row_table
from mvseg.matching.nview.match_nview import refine, search, view_costs, weight_evidence
from mvseg.matching.one_per_view import dense_ids, link_average, one_per_view_clusters
from mvseg.regions import regions_from_label_maps
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_scenes

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]
STARTS = [(iteration, stop) for iteration in (1, 5) for stop in (0.1, 0.2, 0.3, 0.45)]
ROUNDS = 3  # of set packing and refinement


def value_clusters(table: RowTable, W: Floats, clusters: list[Ints], costs: Costs) -> Floats:
    """What each cluster is worth in a partition, see `partition_value`: that depends on its own members only."""
    evidence = weight_evidence(W) * (table.view_index[:, None] != table.view_index)
    values, left = np.zeros(len(clusters)), list(range(len(clusters)))
    while left:  # disjoint ones are looked at together
        ids, chosen = np.full(len(W), -1), []
        for number in left:
            if (ids[clusters[number]] < 0).all():
                ids[clusters[number]] = number
                chosen.append(number)
        scores = own_scores(table, dense_ids(np.where(ids < 0, len(clusters) + np.arange(len(ids)), ids)), costs)
        for number in chosen:
            members = clusters[number]
            pairs = costs.pair_factor(table.num_views) * evidence[np.ix_(members, members)].sum() / 2
            values[number] = scores[members].sum() + pairs
        left = [number for number in left if number not in set(chosen)]
    return values


def search_more(table: RowTable, W: Floats, costs: Costs, parts: list[Ints]) -> Ints:
    """The best of some partitions and of what eight starts and set packing lead to."""
    known, history, evidence = nothing_known(), em_affinities(table), weight_evidence(W)
    parts = [refine(table, W, ids, costs, join_pieces=True, known=known) for ids in parts] + parts
    for iteration, stop in STARTS:
        ids = link_average(history[iteration], table.view_index, table.num_views, stop)
        for join in (False, True):
            ids = refine(table, W, ids, costs, join_pieces=join, known=known)
            parts.append(ids)
    for _ in range(ROUNDS):
        parts.append(pack(table, W, [np.frombuffer(key, np.int64) for key in known.landings], costs))
        parts.append(refine(table, W, parts[-1], costs, join_pieces=True, known=known))
    return max(parts, key=lambda ids: partition_value(table, evidence, ids, costs))


def pack(table: RowTable, W: Floats, pool: list[Ints], costs: Costs) -> Ints:
    """The disjoint clusters of a pool that are worth most together; other regions are alone."""
    pool = [members for members in pool if len(members) > 1]
    values = value_clusters(table, W, pool, costs)
    owner = np.repeat(np.arange(len(pool)), [len(members) for members in pool])
    holds = csc_array((np.ones(len(owner)), (np.concatenate(pool), owner)), shape=(len(W), len(pool)))
    best = milp(-values, constraints=LinearConstraint(holds, ub=1), integrality=1, bounds=Bounds(0, 1))
    ids = len(pool) + np.arange(len(W))
    for number in np.flatnonzero(best.x > 0.5).tolist():
        ids[pool[number]] = number
    return dense_ids(ids)


def judge_scene(spec: SceneSpec, cache: Path, masks: str) -> tuple[int, int, list[float]]:
    """Leaves, views, and ARI and value of the answers: found, by more search, refined from the truth, the truth."""
    torch.set_num_threads(1)
    true, degraded, cameras = load_maps(spec, cache)
    regions = regions_from_label_maps(list(true if masks == "true" else degraded))
    truth = shown_instances(regions, true, count_background=False)
    affinity, costs = region_affinity(regions, cameras), view_costs(len(cameras), Costs())
    W, table = affinity.to_dense().double().numpy(), row_table(regions, cameras)
    pairwise = one_per_view_clusters(affinity, regions.view_index, len(cameras)).numpy()
    pairwise = dense_ids(np.where(pairwise >= 0, pairwise, len(pairwise) + np.arange(len(pairwise))))
    found = search(table, W, costs, pairwise)
    more = search_more(table, W, costs, [pairwise, found])
    refined = refine(table, W, dense_ids(truth.numpy()), costs, join_pieces=True)
    figures: list[float] = []
    for ids in (found, more, refined, dense_ids(truth.numpy())):
        ari = matching_metrics(torch.from_numpy(ids), truth).ari
        figures += [ari, partition_value(table, weight_evidence(W), ids, costs)]
    return spec.num_leaves, spec.num_views, figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for label maps")
    parser.add_argument("--masks", choices=("true", "degraded"), default="degraded")
    parser.add_argument("--leaves", nargs="+", type=int, default=(16, 32))
    parser.add_argument("--views", nargs="+", type=int, default=(3, 5, 10, 20))
    args = parser.parse_args()
    preset = replace(PRESETS["paper-eval"], leaves=tuple(args.leaves), views=tuple(args.views))
    scenes = [one for one in list_scenes(preset, 0) if one.split == "dev"]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        rows = pool.map(partial(judge_scene, cache=args.cache, masks=args.masks), scenes, chunksize=1)
    names = "".join(f"{name:>19}" for name in ("found", "more search", "from the truth", "truth"))
    print(f"leaves views{names}   (ARI, value)")
    for leaves, views in sorted({row[:2] for row in rows}):
        mean = np.mean([row[2] for row in rows if row[:2] == (leaves, views)], 0)
        cells = [f"{ari:10.3f} {value:8.1f}" for ari, value in zip(mean[::2], mean[1::2], strict=True)]
        print(f"{leaves:6}{views:6}" + "".join(cells))


if __name__ == "__main__":
    main()
