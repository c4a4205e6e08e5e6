"""Are match scores probabilities? `python benchmarks/confidence.py --cache ~/mvseg-cells [--split test]`

Scores of the N-view matcher against the share of regions whose id is right, on the scenes of `label_maps` (true and
degraded masks). The id of a region is right when its cluster is the largest one of its leaf, and its leaf is the most
frequent one of its cluster.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.match_nview import match_nview
from mvseg.simulation.dataset import SceneSpec, run_all

EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)


def has_right_id(ids: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(D,) bool; `ids` (D,) are -1 for unmatched regions, `truth` (D,) is the leaf that each region shows."""
    counts = np.zeros((ids.max(initial=0) + 1, truth.max(initial=0) + 1), np.int64)
    np.add.at(counts, (ids[ids >= 0], truth[ids >= 0]), 1)
    return (ids >= 0) & (counts.argmax(1)[ids] == truth) & (counts.argmax(0)[truth] == ids)


def score_scene(spec: SceneSpec, *, cache: Path) -> np.ndarray:
    """(D, 3): number of views, score, and whether the id is right, of the matched regions of one scene."""
    torch.set_num_threads(1)
    scene = load_maps(spec, cache)
    rows = []
    for kind in KINDS:
        regions, truth = scene.masks(kind)
        matching = match_nview(regions, scene.cameras, region_affinity(regions, scene.cameras))
        ids = matching.instance_ids.numpy()
        num_views = np.full(len(ids), spec.num_views)
        right = has_right_id(ids, truth.numpy())
        rows.append(np.stack((num_views, matching.match_scores.numpy(), right), 1)[ids >= 0])
    return np.concatenate(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    args = parser.parse_args()
    rows = np.concatenate(list(run_all(partial(score_scene, cache=args.cache), chosen_scenes(args), args.workers)))
    print(f"{'views':>6}{'score':>14}{'mean score':>12}{'right':>8}{'regions':>9}")
    for views in (0, *sorted(args.views)):
        of_views = rows[(rows[:, 0] == views) | (views == 0)]
        for low, high in pairwise(EDGES):
            bin_rows = of_views[(of_views[:, 1] >= low) & (of_views[:, 1] < high)]
            if len(bin_rows):
                name = f"{low:.2f} - {min(high, 1):.2f}"
                score, right = bin_rows[:, 1:].mean(0)
                print(f"{views or 'all':>6}{name:>14}{score:12.3f}{right:8.3f}{len(bin_rows):9}")


if __name__ == "__main__":
    main()
