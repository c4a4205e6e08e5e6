"""How likely do two masks show one leaf? `python -m benchmarks.pair_odds --cache DIR [--leaves ...] [--views ...]`

Counts pairs of degraded masks of two views on development plants by their epipolar weight, and prints the log odds that
both show the same leaf at the weights of `mvseg/matching/nview/cluster_scores.py`, with those that stand there. A pair
counts for the two nearest of these weights, in proportion; of each, half a pair of either kind is there already.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from benchmarks.label_maps import add_scene_options, chosen_scenes, load_maps
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.cluster_scores import LOG_ODDS, WEIGHTS


def count_pairs(weights: np.ndarray, is_same: np.ndarray) -> np.ndarray:
    """(2, W) pairs that show two leaves, and one, at each of `WEIGHTS`."""
    counts = []
    for each in (weights[~is_same], weights[is_same]):
        place = np.interp(each, WEIGHTS, np.arange(len(WEIGHTS)))
        low = place.astype(int)
        high = np.minimum(low + 1, len(WEIGHTS) - 1)
        shares = [np.bincount(low, 1 - place + low, len(WEIGHTS)), np.bincount(high, place - low, len(WEIGHTS))]
        counts.append(sum(shares))
    return np.array(counts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    counts = np.full((2, len(WEIGHTS)), 0.5)
    for spec in chosen_scenes(args):
        scene = load_maps(spec, args.cache)
        regions, leaf = scene.masks("degraded")
        affinity = region_affinity(regions, scene.cameras).to_dense().numpy()
        views = regions.view_index.numpy()
        one, other = np.nonzero(views[:, None] < views)
        counts += count_pairs(affinity[one, other], (leaf[one] == leaf[other]).numpy() & (leaf[one] > 0).numpy())
    print("| weight | pairs | log odds | in the code |\n|---|---|---|---|")
    for weight, (apart, same), stated in zip(WEIGHTS, counts.T, LOG_ODDS, strict=True):
        print(f"| {weight:g} | {apart + same - 1:.0f} | {np.log(same / apart):.1f} | {stated:g} |")


if __name__ == "__main__":
    main()
