"""Where is the limit of the N-view matcher? `python benchmarks/oracle.py --cache DIR [--leaves 16 32]`

On development plants (like those of benchmarks/matching.py), four answers: that of the matcher; that of a much longer
search, from eight starts and by set packing (an integer programme chooses disjoint clusters among all ever seen); the
true ids after refinement; and the true ids. Each has its ARI and its value in the matcher's objective. As long as the
truth has a lower value than the matcher's answer, a longer search cannot help: only another objective can.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csc_array

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.label_maps import KINDS, load_maps
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.initialisation import em_affinities
from mvseg.matching.nview.plane_sweep import sweep_planes
from mvseg.matching.nview.search import refine, search
from mvseg.matching.one_per_view import ViewGraph, link_average, one_per_view_clusters
from mvseg.matching.partition import renumber, separate_unmatched
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_scenes
from mvseg.system.worker_pool import run_all

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]
INITIALISATIONS = [(iteration, stop) for iteration in (1, 5) for stop in (0.1, 0.2, 0.3, 0.45)]
ROUNDS = 3  # of set packing and refinement


def value_clusters(scores: ClusterScores, clusters: list[Ints]) -> Floats:
    """What each cluster adds to the value of a partition: this depends on its own members only."""
    views = scores.sweep.view_index
    evidence = scores.evidence * (views[:, None] != views)
    values, waiting = np.zeros(len(clusters)), list(range(len(clusters)))
    while waiting:  # disjoint clusters are scored together
        numbers, chosen = np.full(len(views), -1), []
        for number in waiting:
            if (numbers[clusters[number]] < 0).all():
                numbers[clusters[number]] = number
                chosen.append(number)
        own = scores.own(renumber(separate_unmatched(numbers)))
        for number in chosen:
            members = clusters[number]
            pairs = scores.pair_factor * evidence[np.ix_(members, members)].sum() / 2
            values[number] = own[members].sum() + pairs
        waiting = [number for number in waiting if number not in set(chosen)]
    return values


def search_more(scores: ClusterScores, partitions: list[Ints]) -> Ints:
    """The best of some partitions and of those that eight starts and set packing lead to."""
    sweep, history = scores.sweep, em_affinities(scores.sweep)
    tried = [refine(scores, clusters, join_fragments=True) for clusters in partitions] + partitions
    for iteration, stop in INITIALISATIONS:
        clusters = link_average(ViewGraph(history[iteration], sweep.view_index, sweep.num_views), stop)
        for join_fragments in (False, True):
            clusters = refine(scores, clusters, join_fragments=join_fragments)
            tried.append(clusters)
    for _ in range(ROUNDS):
        tried.append(pack(scores))
        tried.append(refine(scores, tried[-1], join_fragments=True))
    return max(tried, key=scores.value)


def pack(scores: ClusterScores) -> Ints:
    """The disjoint clusters of largest value together, among all whose coverages were computed; others are alone."""
    pool = [members for members in scores.covered_clusters() if len(members) > 1]
    values, num_regions = value_clusters(scores, pool), len(scores.sweep.view_index)
    owner = np.repeat(np.arange(len(pool)), [len(members) for members in pool])
    holds = csc_array((np.ones(len(owner)), (np.concatenate(pool), owner)), shape=(num_regions, len(pool)))
    best = milp(-values, constraints=LinearConstraint(holds, ub=1), integrality=1, bounds=Bounds(0, 1))
    clusters = np.full(num_regions, -1)
    for number in np.flatnonzero(best.x > 0.5).tolist():
        clusters[pool[number]] = number
    return renumber(separate_unmatched(clusters))


def judge_scene(spec: SceneSpec, *, cache: Path, kind: str) -> tuple[int, int, list[float]]:
    """Leaves, views, and ARI and value of four answers: matcher, longer search, refined truth, truth."""
    torch.set_num_threads(1)
    scene = load_maps(spec, cache)
    num_views = len(scene.cameras)
    regions, truth = scene.masks(kind)
    affinity, sweep = region_affinity(regions, scene.cameras), sweep_planes(regions, scene.cameras)
    graph = ViewGraph.of(affinity, regions.view_index, num_views)
    scores = ClusterScores(sweep, graph, NViewConfig().for_views(num_views))
    pairwise = renumber(separate_unmatched(one_per_view_clusters(affinity, regions.view_index, num_views).numpy()))
    matched = search(scores, pairwise)
    longer = search_more(ClusterScores(sweep, graph, scores.config), [pairwise, matched])
    true = renumber(truth.numpy())
    refined = refine(scores, true, join_fragments=True)
    figures: list[float] = []
    for clusters in (matched, longer, refined, true):
        figures += [matching_metrics(torch.from_numpy(clusters), truth).ari, scores.value(clusters)]
    return spec.num_leaves, spec.num_views, figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for rendered label maps")
    parser.add_argument("--masks", choices=KINDS, default="degraded")
    parser.add_argument("--leaves", nargs="+", type=int, default=(16, 32))
    parser.add_argument("--views", nargs="+", type=int, default=(3, 5, 10, 20))
    args = parser.parse_args()
    preset = replace(PRESETS["paper-eval"], leaves=tuple(args.leaves), views=tuple(args.views))
    scenes = [scene for scene in list_scenes(preset, 0) if scene.split == "dev"]
    rows = list(run_all(partial(judge_scene, cache=args.cache, kind=args.masks), scenes, num_workers=2))
    names = "".join(f"{name:>19}" for name in ("matcher", "longer search", "refined truth", "truth"))
    print(f"leaves views{names}   (ARI, value)")
    for leaves, views in sorted({row[:2] for row in rows}):
        mean = np.mean([row[2] for row in rows if row[:2] == (leaves, views)], 0)
        cells = [f"{ari:10.3f} {value:8.1f}" for ari, value in zip(mean[::2], mean[1::2], strict=True)]
        print(f"{leaves:6}{views:6}" + "".join(cells))


if __name__ == "__main__":
    main()
