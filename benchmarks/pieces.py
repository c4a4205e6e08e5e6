"""Which masks of one photo are pieces of one leaf? `python -m benchmarks.pieces --cache ~/mvseg-cells`

Masks of development plants (`label_maps`, 8 to 32 leaves in 5 and 10 views, true and degraded; and straps, whole, in
pieces and degraded), as they are, and with all masks but one of a leaf taken away, six leaves of each. What the search
puts into one cluster of one photo is right where both masks show one leaf. Prints the coefficients of `match_nview.py`,
fitted to all, and, with each plant left out in turn, how many right pieces and how many strangers are likelier pieces
than not.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.special import expit

from benchmarks.choice import regress
from benchmarks.label_maps import load_maps, plant_index
from benchmarks.straps import draw_straps, list_masks
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.match_nview import PIECE, find_clusters, piece_features
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.simulation.dataset import PRESETS, list_specs

LEAVES, VIEWS, PLANTS, STRAPS = (8, 16, 32), (5, 10), 2, (8, 12)
FIRST_STRAP = 7100  # seed
LONE = 6  # leaves of a scene that are left with one mask, in turn


def list_kinds(cache: Path) -> Iterator[tuple[str, Regions, torch.Tensor, Cameras]]:
    """Name of the plant, masks, the leaf that each shows, cameras."""
    for num_leaves in STRAPS:
        for number in range(PLANTS):
            true, cameras = draw_straps(num_leaves, FIRST_STRAP + number)
            for masks in list_masks(true).values():
                yield f"strap {num_leaves} {number}", *masks, cameras
    for spec in list_specs(PRESETS["paper-eval"], 0):
        is_asked = spec.num_leaves in LEAVES and spec.num_views in VIEWS and plant_index(spec) < PLANTS
        if spec.split == "dev" and is_asked:
            scene = load_maps(spec, cache)
            for kind in ("true", "degraded"):
                yield spec.folder.rpartition("_")[0], *scene.masks(kind), scene.cameras


def judge(
    regions: Regions, leaf: torch.Tensor, cameras: Cameras, lone: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 4) features of the pieces, of those beside region `lone` only if there is one, and (P,) whether they show
    the leaf of their cluster."""
    affinity = region_affinity(regions, cameras)
    found = find_clusters(regions, cameras, ViewGraph.of(affinity, regions))
    rows, features = piece_features(found.scores, found.clusters)
    if lone is not None:
        place = found.clusters.ids * len(cameras) + regions.view_index.numpy()
        is_asked = place[rows] == place[lone]
        rows, features = rows[is_asked], features[is_asked]
    shown, ids = leaf.numpy(), found.clusters.ids
    main = np.array([np.bincount(shown[ids == k]).argmax() for k in ids[rows]], np.int64)
    return features, (shown[rows] == main) & (shown[rows] > 0) & (lone is None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for rendered label maps")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, plants, rows, right = np.random.default_rng(0), [], [], []
    for plant, regions, leaf, cameras in list_kinds(args.cache):
        shown = leaf.numpy()
        cases: list[tuple[np.ndarray, int | None]] = [(np.arange(len(shown)), None)]
        for each in rng.permutation(np.unique(shown[shown > 0]))[:LONE]:
            lone = rng.choice(np.flatnonzero(shown == each))
            keep = np.flatnonzero((shown != each) | (np.arange(len(shown)) == lone))
            cases.append((keep, int(np.searchsorted(keep, lone))))
        for keep, place in cases:
            chosen = torch.from_numpy(keep)
            features, is_right = judge(regions.select(chosen), leaf[chosen], cameras, place)
            rows.append(features)
            right.append(is_right)
            plants += [plant] * len(features)
    features, is_right, plant_of = np.concatenate(rows), np.concatenate(right), np.array(plants)
    chance = np.zeros(len(features))
    for plant in np.unique(plant_of):
        own = plant_of == plant
        chance[own] = expit(features[own] @ [*regress(PIECE, features[~own], is_right[~own]).values()])
    print(f"{len(features)} pieces, {is_right.sum()} right: of these stay {(chance[is_right] >= 0.5).mean():.3f}, "
          f"of the others {(chance[~is_right] >= 0.5).mean():.3f}")  # fmt: skip
    print("PIECE =", regress(PIECE, features, is_right))


if __name__ == "__main__":
    main()
