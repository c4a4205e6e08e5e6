"""Are match scores probabilities, and are wrong poses noticed? `python -m benchmarks.confidence --cache ~/mvseg-cells`

The scenes are those of `label_maps` with at most `MOST_MASKS` true masks; true and degraded masks, and those that the
shipped detector finds. Each is matched with exact poses and with `DRAWS` of the faults of `camera_faults`, drawn at
random. The id of a region is right when its cluster is the largest one of its leaf, and its leaf is the most frequent
one of its cluster; detections that show no leaf do not count.

1. Scores against the share of regions whose id is right: the expected calibration error is the mean difference over ten
   equal bins, weighted by the number of regions.
2. How many scenes are warned of: poses spoil the ids of a scene when its ARI is below 0.8, and more than 0.1 below that
   with exact poses; the ids are sound when they are right with an ARI of 0.8 or more.

`--fit` prints the coefficients of `match_scores.py` as fitted on these scenes; it is for the split "dev". Look at
"test" once, at the end.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.camera_faults import FAULTS, faulty_cameras
from benchmarks.choice import regress
from benchmarks.label_maps import add_scene_options, chosen_scenes, load_detected, load_maps
from mvseg.errors import collect_warnings
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.findings.sentences import DISAGREEMENT
from mvseg.matching.affinity import region_affinity
from mvseg.matching.match import match_regions
from mvseg.matching.nview.match_nview import find_clusters
from mvseg.matching.nview.match_scores import SCENE, collect_evidence, scene_features
from mvseg.matching.view_graph import ViewGraph
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.simulation.dataset import SceneSpec
from mvseg.system.worker_pool import run_all

KINDS = ("true", "degraded", "detected")
EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)
NUM_BINS = 10  # of the calibration error
MOST_MASKS, DRAWS = 100, 4  # leaves times views of a scene; faults of its cameras
SPOILT, LOSS = 0.8, 0.1  # ARI below which, and loss of ARI from which, poses spoil the ids


@dataclass(frozen=True, eq=False)
class Outcome:
    """One scene with one kind of masks and one fault.

    Attributes:
        kind, fault: which.
        num_views: V.
        ari: over the regions that show a leaf.
        is_warned: whether `match_regions` warns that the views disagree.
        scores: (N,) of the matched regions that show a leaf.
        is_right: (N,) bool.
        features: (N, 5), see `scene_features`; None where they were not asked for.
    """

    kind: str
    fault: str
    num_views: int
    ari: float
    is_warned: bool
    scores: NDArray[np.floating]
    is_right: NDArray[np.bool_]
    features: NDArray[np.floating] | None


def has_right_id(ids: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(D,) bool; `ids` (D,) are -1 for unmatched regions, `truth` (D,) is the leaf that each region shows."""
    counts = np.zeros((ids.max(initial=0) + 1, truth.max(initial=0) + 1), np.int64)
    np.add.at(counts, (ids[ids >= 0], truth[ids >= 0]), 1)
    return (ids >= 0) & (counts.argmax(1)[ids] == truth) & (counts.argmax(0)[truth] == ids)


def run_scene(spec: SceneSpec, *, cache: Path, is_fit: bool) -> list[Outcome]:
    """All kinds of masks of one scene, each with exact poses first."""
    torch.set_num_threads(1)
    scene, outcomes = load_maps(spec, cache), []
    for number, kind in enumerate(KINDS):
        if kind == "detected":
            regions = load_detected(spec, cache)
            truth = true_instances(regions, list(scene.true))
        else:
            regions, truth = scene.masks(kind)
        rng = np.random.default_rng([spec.seed, spec.num_views, number])
        drawn = [FAULTS[index] for index in rng.choice(len(FAULTS), DRAWS, replace=False)]
        for fault in ("exact", *drawn):
            cameras = faulty_cameras(scene.cameras, fault, rng)
            outcomes.append(judge(regions, truth, cameras, kind=kind, fault=fault, is_fit=is_fit))
    return outcomes


def judge(regions: Regions, truth: Tensor, cameras: Cameras, *, kind: str, fault: str, is_fit: bool) -> Outcome:
    """Match; `truth` (D,) is the leaf that each region shows, 0 = none."""
    found = None
    if is_fit:
        ids, found = clusters_and_features(regions, cameras)
        scores, is_warned = np.zeros(len(ids)), False
    else:
        with collect_warnings() as findings:
            matching = match_regions(regions, cameras)
        ids, scores = matching.instance_ids, matching.match_scores.numpy()
        is_warned = any(each.code in DISAGREEMENT for each in findings)
    shows = truth > 0
    counts = ((ids > 0) & shows).numpy()
    return Outcome(
        kind=kind,
        fault=fault,
        num_views=len(cameras),
        ari=matching_metrics(ids[shows], truth[shows]).ari,
        is_warned=is_warned,
        scores=scores[counts],
        is_right=has_right_id(ids.numpy(), truth.numpy())[counts],
        features=None if found is None else found[counts],
    )


def clusters_and_features(regions: Regions, cameras: Cameras) -> tuple[Tensor, NDArray[np.floating]]:
    """(D,) int64 ids, -1 for regions alone, and (D, 5) `scene_features`; the regions are ordered by view."""
    affinity = region_affinity(regions, cameras)
    found = find_clusters(regions, cameras, ViewGraph.of(affinity, regions))
    evidence = collect_evidence(found.scores, found.clusters, found.pairwise)
    return found.clusters.drop_singletons().instance_ids(), scene_features(evidence)


def calibration_error(scores: NDArray[np.floating], is_right: NDArray[np.bool_]) -> float:
    """Mean |score - share that is right| over ten equal bins, weighted by their regions."""
    bins = np.minimum((scores * NUM_BINS).astype(int), NUM_BINS - 1)
    counts = np.bincount(bins, minlength=NUM_BINS)
    gaps = np.bincount(bins, scores - is_right, NUM_BINS)
    return float(np.abs(gaps).sum() / max(counts.sum(), 1))


def print_scores(outcomes: list[Outcome]) -> None:
    scores, right = (np.concatenate([getattr(each, name) for each in outcomes]) for name in ("scores", "is_right"))
    print(f"{'score':>14}{'mean score':>12}{'right':>8}{'regions':>9}")
    for low, high in pairwise(EDGES):
        inside = (scores >= low) & (scores < high)
        if inside.any():
            name = f"{low:.2f} - {min(high, 1):.2f}"
            print(f"{name:>14}{scores[inside].mean():12.3f}{right[inside].mean():8.3f}{inside.sum():9}")


def print_groups(outcomes: list[Outcome]) -> None:
    """One row per group of scenes: how well scores are calibrated, and how many are warned of."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    base, with_exact = {}, 0.0
    for each in outcomes:  # of each scene, exact poses come first
        is_exact = each.fault == "exact"
        base[id(each)] = with_exact = each.ari if is_exact else with_exact
        poses = "exact" if is_exact else "wrong poses"
        for name in {"all", poses, f"{poses}, {each.kind}", each.fault, f"{each.num_views} views"}:
            groups[name].append(each)
    header = ("regions", "right", "score", "error", "ARI", "scenes", "spoilt", "warned", "sound", "warned")
    print(f"{'':22}" + "".join(f"{name:>8}" for name in header))
    for name in sorted(groups):
        rows = groups[name]
        scores, right = (np.concatenate([getattr(each, what) for each in rows]) for what in ("scores", "is_right"))
        is_spoilt = [each.ari < SPOILT and base[id(each)] - each.ari > LOSS for each in rows]
        is_sound = [each.ari >= SPOILT for each in rows]
        figures = (right.mean(), scores.mean(), calibration_error(scores, right), np.mean([each.ari for each in rows]))
        counts = (len(rows), sum(is_spoilt), warned(rows, is_spoilt), sum(is_sound), warned(rows, is_sound))
        print(f"{name:22}{len(right):8}" + "".join(f"{x:8.3f}" for x in figures) + "".join(f"{n:8}" for n in counts))


def warned(outcomes: list[Outcome], chosen: list[bool]) -> int:
    return sum(each.is_warned for each, is_chosen in zip(outcomes, chosen, strict=True) if is_chosen)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--fit", action="store_true", help="print coefficients")
    args = parser.parse_args()
    work = partial(run_scene, cache=args.cache, is_fit=args.fit)
    specs = [spec for spec in chosen_scenes(args) if spec.num_leaves * spec.num_views <= MOST_MASKS]
    outcomes = [each for of_scene in run_all(work, specs, args.workers) for each in of_scene]
    if args.fit:
        features = np.concatenate([each.features for each in outcomes if each.features is not None])
        print("SCENE =", regress(SCENE, features, np.concatenate([each.is_right for each in outcomes])))
        return
    print_scores(outcomes)
    print_groups(outcomes)


if __name__ == "__main__":
    main()
