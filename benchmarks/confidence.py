"""Are match scores chances? `python benchmarks/confidence.py --cache ~/mvseg-cells [--split test]`

Scores of the N-view matcher against the share of regions that are right, on the scenes of benchmarks/matching.py (true
and degraded masks). A region is right when its cluster is the largest one of its leaf, and its leaf is the most
frequent one of its cluster.
"""

from __future__ import annotations

import argparse
import multiprocessing
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from matching import load_maps
from mvseg.evaluation.truth import shown_instances
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.match_nview import match_nview
from mvseg.regions import regions_from_label_maps
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_scenes

EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)


def right_regions(ids: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(D,) bool."""
    table = np.zeros((ids.max(initial=0) + 1, truth.max(initial=0) + 1), np.int64)
    np.add.at(table, (ids[ids >= 0], truth[ids >= 0]), 1)
    return (ids >= 0) & (table.argmax(1)[ids] == truth) & (table.argmax(0)[truth] == ids)


def score_scene(spec: SceneSpec, cache: Path) -> np.ndarray:
    """(D, 3): number of views, score, and whether it is right, of the matched regions of one scene."""
    torch.set_num_threads(1)
    true, degraded, cameras = load_maps(spec, cache)
    rows = []
    for maps in (true, degraded):
        regions = regions_from_label_maps(list(maps))
        found = match_nview(regions, cameras, region_affinity(regions, cameras))
        ids = found.instance_ids.numpy()
        right = right_regions(ids, shown_instances(regions, true, count_background=False).numpy())
        rows.append(np.stack((np.full(len(ids), spec.num_views), found.match_scores.numpy(), right), 1)[ids >= 0])
    return np.concatenate(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="folder for label maps")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--seed", type=int, default=0, help="of the plants; another one for plants never looked at")
    args = parser.parse_args()
    scenes = [scene for scene in list_scenes(PRESETS["paper-eval"], args.seed) if scene.split == args.split]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        rows = np.concatenate(pool.map(partial(score_scene, cache=args.cache), scenes, chunksize=1))
    print(f"{'views':>6}{'scored':>14}{'mean score':>12}{'right':>8}{'regions':>9}")
    for views in (0, 3, 5, 10, 20):
        own = rows[(rows[:, 0] == views) | (views == 0)]
        for low, high in pairwise(EDGES):
            pick = own[(own[:, 1] >= low) & (own[:, 1] < high)]
            if len(pick):
                name = f"{low:.2f} - {min(high, 1):.2f}"
                print(f"{views or 'all':>6}{name:>14}{pick[:, 1].mean():12.3f}{pick[:, 2].mean():8.3f}{len(pick):9}")


if __name__ == "__main__":
    main()
