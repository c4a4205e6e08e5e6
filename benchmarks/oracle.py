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
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.label_rows import row_table
from mvseg.matching.nview.search import refine, search
from mvseg.matching.nview.soft_start import em_affinities
from mvseg.matching.one_per_view import ViewGraph, link_average, one_per_view_clusters
from mvseg.partition import renumber, separate_unmatched
from mvseg.regions import regions_from_label_maps
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_scenes

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]
STARTS = [(iteration, stop) for iteration in (1, 5) for stop in (0.1, 0.2, 0.3, 0.45)]
ROUNDS = 3  # of set packing and refinement


def value_clusters(scores: ClusterScores, clusters: list[Ints]) -> Floats:
    """What each cluster is worth in a partition, see `ClusterScores.value`: that depends on its own members only."""
    views = scores.table.view_index
    evidence = scores.evidence * (views[:, None] != views)
    values, left = np.zeros(len(clusters)), list(range(len(clusters)))
    while left:  # disjoint ones are looked at together
        numbers, chosen = np.full(len(views), -1), []
        for number in left:
            if (numbers[clusters[number]] < 0).all():
                numbers[clusters[number]] = number
                chosen.append(number)
        own = scores.own(renumber(separate_unmatched(numbers)))
        for number in chosen:
            members = clusters[number]
            pairs = scores.pair_factor * evidence[np.ix_(members, members)].sum() / 2
            values[number] = own[members].sum() + pairs
        left = [number for number in left if number not in set(chosen)]
    return values


def search_more(scores: ClusterScores, parts: list[Ints]) -> Ints:
    """The best of some partitions and of what eight starts and set packing lead to."""
    history = em_affinities(scores.table)
    parts = [refine(scores, clusters, join_pieces=True) for clusters in parts] + parts
    for iteration, stop in STARTS:
        clusters = link_average(ViewGraph(history[iteration], scores.table.view_index, scores.table.num_views), stop)
        for join_pieces in (False, True):
            clusters = refine(scores, clusters, join_pieces=join_pieces)
            parts.append(clusters)
    for _ in range(ROUNDS):
        parts.append(pack(scores))
        parts.append(refine(scores, parts[-1], join_pieces=True))
    return max(parts, key=scores.value)


def pack(scores: ClusterScores) -> Ints:
    """The disjoint clusters that are worth most together, of all that were ever scored; other regions are alone."""
    pool = [members for members in scores.landed_clusters() if len(members) > 1]
    values, num_regions = value_clusters(scores, pool), len(scores.table.view_index)
    owner = np.repeat(np.arange(len(pool)), [len(members) for members in pool])
    holds = csc_array((np.ones(len(owner)), (np.concatenate(pool), owner)), shape=(num_regions, len(pool)))
    best = milp(-values, constraints=LinearConstraint(holds, ub=1), integrality=1, bounds=Bounds(0, 1))
    clusters = np.full(num_regions, -1)
    for number in np.flatnonzero(best.x > 0.5).tolist():
        clusters[pool[number]] = number
    return renumber(separate_unmatched(clusters))


def judge_scene(spec: SceneSpec, cache: Path, masks: str) -> tuple[int, int, list[float]]:
    """Leaves, views, and ARI and value of the answers: found, by more search, refined from the truth, the truth."""
    torch.set_num_threads(1)
    true, degraded, cameras = load_maps(spec, cache)
    regions = regions_from_label_maps(list(true if masks == "true" else degraded))
    truth = shown_instances(regions, true, count_background=False)
    true_clusters = renumber(truth.numpy())
    affinity, num_views = region_affinity(regions, cameras), len(cameras)
    graph = ViewGraph(affinity.to_dense().double().numpy(), regions.view_index.numpy(), num_views)
    scores = ClusterScores(row_table(regions, cameras), graph, NViewConfig().for_views(num_views))
    pairwise = renumber(separate_unmatched(one_per_view_clusters(affinity, regions.view_index, num_views).numpy()))
    found = search(scores, pairwise)
    more = search_more(ClusterScores(scores.table, graph, scores.config), [pairwise, found])
    refined = refine(scores, true_clusters, join_pieces=True)
    figures: list[float] = []
    for clusters in (found, more, refined, true_clusters):
        figures += [matching_metrics(torch.from_numpy(clusters), truth).ari, scores.value(clusters)]
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
