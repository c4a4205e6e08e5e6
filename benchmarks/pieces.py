"""Which masks of one photo are pieces of one leaf? `python benchmarks/pieces.py --cache ~/mvseg-cells`

Masks of development plants (`label_maps`, 8 to 32 leaves in 5 and 10 views, true and degraded; and straps, whole, in
pieces and degraded), as they are, and with all masks but one of a leaf taken away, six leaves of each. What the search
puts into one cluster of one photo is right where both masks show one leaf. Prints the coefficients of `match_nview.py`,
fitted to all, and, with each plant left out in turn, how many right pieces and how many strangers are likelier pieces
than not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.faults import Faults, degrade_labels
from benchmarks.label_maps import load_maps, plant_index, visible_ids
from benchmarks.straps import cut_pieces, strap_cameras
from mvseg.evaluation.truth import true_instances
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.match_nview import PIECE, find_clusters, piece_features
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.dataset import PRESETS, list_specs
from mvseg.simulation.growth import grow_plant

LEAVES, VIEWS, PLANTS, STRAPS = (8, 16, 32), (5, 10), 2, (8, 12)
FIRST_STRAP = 7100  # seed
LONE = 6  # leaves of a scene that are left with one mask, in turn
RIDGE = 0.05


def list_kinds(cache: Path) -> Iterator[tuple[str, Regions, torch.Tensor, Cameras]]:
    """Name of the plant, masks, the leaf that each shows, cameras."""
    for num_leaves in STRAPS:
        for number in range(PLANTS):
            plant = grow_plant("strap", num_leaves, FIRST_STRAP + number)
            cameras = strap_cameras(plant)
            true = visible_ids(plant, cameras)
            pieces = [cut_pieces(labels) for labels in true]
            faulty = [degrade_labels(labels, Faults(), seed=view) for view, labels in enumerate(pieces)]
            for maps in (list(true), pieces, faulty):
                regions = regions_from_label_maps(maps)
                leaf = true_instances(regions, list(true), count_background=False)
                yield f"strap {num_leaves} {number}", regions, leaf, cameras
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


def fit(features: np.ndarray, is_right: np.ndarray) -> np.ndarray:
    """Weights of greatest likelihood, that of the constant first."""
    sign = np.where(is_right, 1, -1)
    return minimize(
        lambda b: np.logaddexp(0, -sign * (features @ b)).sum() + RIDGE * (b[1:] ** 2).sum(),
        np.zeros(features.shape[1]),
    ).x


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
        b = fit(features[~own], is_right[~own])
        chance[own] = expit(features[own] @ b)
    print(f"{len(features)} pieces, {is_right.sum()} right: of these stay {(chance[is_right] >= 0.5).mean():.3f}, "
          f"of the others {(chance[~is_right] >= 0.5).mean():.3f}")  # fmt: skip
    print("PIECE =", dict(zip(PIECE, fit(features, is_right).round(2).tolist(), strict=True)))


if __name__ == "__main__":
    main()
