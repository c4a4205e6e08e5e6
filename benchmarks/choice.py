"""What the choice of leaves is fitted on, and what it loses: `python -m benchmarks.choice SCENE ... [--leave_out]`

The scenes have photos, cameras and `truth/`; those of `MANY` photos or more are looked at a second time with every
other photo, so that the numbers hold for plants that few photos show, too, and `--sizes` looks at them at other sizes,
at which the detector knows less. For each: what its detector proposes, the
candidates, and which masks show which true leaf. The numbers of `mvseg/verification/leaf_scores.py` are fitted by
maximum likelihood (a small ridge), in three rounds, since the features of a candidate depend on what was chosen before
it. With `--leave_out` the plants are parted in four, and each scene is judged by numbers that were fitted on the other
three parts (scenes whose names share what stands behind the last "-" are one plant). Per scene: MV-PQ of what was
chosen, before and after `snap_masks`; its ceilings (before it), the best proposal of each true mask that scores 0.3,
0.1 or 0.05 and has an IoU above one half, with the right id. In the end: how often candidates of each P are right.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.special import expit

from mvseg.config import RunConfig
from mvseg.detection.numbers import DETECTION
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.formats.label_png import read_label_png
from mvseg.formats.lens import undistort
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.pipeline.find_in_photos import run_pass
from mvseg.pipeline.open_scene import Opened
from mvseg.regions import IGNORE_LABEL
from mvseg.scene import Scene
from mvseg.verification.candidates import Candidates, gather_candidates
from mvseg.verification.choice import choose
from mvseg.verification.choose import Judges
from mvseg.verification.evidence import Drawn, draw_views, see
from mvseg.verification.leaf_scores import FITTED, LEAF_TERMS, TERMS, LeafScores, Pairs
from mvseg.verification.snap_edges import snap_masks

RIDGE, ROUNDS, SHOWS = 0.1, 3, 0.5  # SHOWS: IoU from which a mask shows a leaf
MANY, PARTS = 8, 4
SCORES = (DETECTION.sure_score, DETECTION.more_score, DETECTION.least_score)
BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 1.01)


@dataclass(frozen=True, eq=False)
class Study:
    """One scene: its proposals, candidates and truth; `leaf` (D,) and `of_candidate` (K,) are true leaves, -1 for none
    and -2 for what is ignored."""

    name: str
    table: Masks
    candidates: Candidates
    drawn: tuple[Drawn, ...]
    photos: Photos
    truth: list[np.ndarray]
    leaf: np.ndarray
    of_candidate: np.ndarray


def study(folder: Path, step: int = 1, size: int | None = None) -> Study | None:
    """A scene with every `step`-th photo, seen at a size (pixels; None: the detector's own); None where that leaves too
    few photos."""
    scene = load_scene(folder)
    if step > 1 and len(scene.views) < MANY:
        return None
    scene = replace(scene, views=scene.views[::step], cameras=scene.cameras[list(range(0, len(scene.views), step))])
    truth = true_maps(folder, scene)
    opened = Opened(scene, Photos(scene), RunConfig())
    plant = run_pass(opened, size, cache=None)
    table = plant.proposals
    candidates = gather_candidates(plant.matched, table, Judges(scene.cameras).fit)
    drawn = draw_views(table.regions, candidates.surfaces, scene.cameras, photos=Photos(scene))
    leaf = true_leaves(table, truth)
    members = [~np.isnan(column) for column in candidates.matched.T]
    of_candidate = np.array([main_leaf(leaf[rows]) for rows in members])
    name = "".join((f"every {step}: " * (step > 1), f"at {size}: " * (size is not None), folder.name))
    return Study(name, table, candidates, drawn, Photos(scene), truth, leaf, of_candidate)


def true_maps(folder: Path, scene: Scene, kind: str = "truth") -> list[np.ndarray]:
    """V true label maps of leaves, or of `organs`, in the frames of the undistorted photos."""
    maps = []
    for view, size, K in zip(scene.views, scene.cameras.sizes.tolist(), scene.cameras.K, strict=True):
        maps.append(undistort(read_label_png(folder / kind / f"{view.name}.png", *size), view.lens, K.numpy()))
    return maps


def true_leaves(table: Masks, truth: list[np.ndarray]) -> np.ndarray:
    """(D,) the leaf that each mask shows."""
    leaves = np.full(len(table), -1)
    areas = [np.bincount(labels.ravel(), minlength=IGNORE_LABEL + 1) for labels in truth]
    for row in range(len(table)):
        view, (x1, y1, x2, y2) = int(table.view_index[row]), table.regions.boxes[row].tolist()
        shown = truth[view][y1:y2, x1:x2][table.regions.crop(row).numpy()]
        if not len(shown):
            continue
        counts = np.bincount(shown, minlength=IGNORE_LABEL + 1)
        if counts[IGNORE_LABEL] > SHOWS * len(shown):
            leaves[row] = -2
            continue
        counts[[0, IGNORE_LABEL]] = 0
        best = int(counts.argmax())
        if counts[best] > SHOWS * (len(shown) + areas[view][best] - counts[best]):
            leaves[row] = best
    return leaves


def main_leaf(leaves: np.ndarray) -> int:
    """The leaf that most of these masks show; -1 if none does in half of them."""
    names, counts = np.unique(leaves, return_counts=True)
    return int(names[counts.argmax()]) if counts.max() >= SHOWS * len(leaves) else -1


def regress(names: Iterable[str], features: np.ndarray, is_right: np.ndarray) -> dict[str, float]:
    """The weights of these features, by Newton's method; the constant is free."""
    b, ridge = np.zeros(features.shape[1]), RIDGE * np.eye(features.shape[1])
    ridge[0, 0] = 1e-6
    for _ in range(60):
        p = expit(features @ b)
        slope = features.T @ (is_right - p) - ridge @ b
        step = np.linalg.solve((features.T * (p * (1 - p))) @ features + ridge, slope)
        b += step * min(1, 5 / max(np.abs(step).max(), 1e-9))
    return dict(zip(names, b.round(3).tolist(), strict=True))


def fit(studies: list[Study]) -> LeafScores:
    """The numbers of greatest likelihood."""
    fitted = FITTED
    for _ in range(ROUNDS):
        shows: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        matched: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        leaves: dict[bool, tuple[list[np.ndarray], list[bool]]] = {True: ([], []), False: ([], [])}
        for each in studies:
            for (x, y), into in zip(mask_samples(each, fitted), (shows, matched), strict=True):
                into[0].append(x)
                into[1].append(y)
            bare = replace(each.candidates, surfaces=(None,) * len(each.candidates))
            for candidates in (each.candidates, bare):
                for has_surface, features, is_right, _ in leaf_samples(each, candidates, fitted):
                    leaves[has_surface][0].append(features)
                    leaves[has_surface][1].append(is_right)
        fitted = LeafScores(
            shows=regress(FITTED.shows, np.concatenate(shows[0]), np.concatenate(shows[1])),
            matched=regress(FITTED.matched, np.concatenate(matched[0]), np.concatenate(matched[1])),
            leaf=regress(FITTED.leaf, of_terms(FITTED.leaf, leaves[True][0]), np.array(leaves[True][1])),
            leaf_matched=regress(
                FITTED.leaf_matched, of_terms(FITTED.leaf_matched, leaves[False][0]), np.array(leaves[False][1])
            ),
        )
    return fitted


def of_terms(weights: Iterable[str], rows: list[np.ndarray]) -> np.ndarray:
    """(N, T) values of the terms that have a weight, of rows with those of all `LEAF_TERMS`."""
    return np.array(rows)[:, [list(LEAF_TERMS).index(name) for name in weights]]


def mask_samples(each: Study, fitted: LeafScores) -> list[tuple[np.ndarray, np.ndarray]]:
    """Features of pairs of masks and candidates, and whether they are right: with a surface, and without."""
    scores = each.table.detection_scores.double().numpy()
    chosen = choose(each.candidates, each.table, drawn=each.drawn, fitted=fitted)
    hides = np.zeros(len(each.candidates), bool)
    hides[chosen.candidates] = True
    evidence = see(each.drawn, len(scores), hides & each.candidates.is_credible)
    is_known = (each.leaf != -2)[:, None] & (each.of_candidate != -2)
    is_right = (each.leaf[:, None] == each.of_candidate) & (each.of_candidate > 0)
    near = is_known & (evidence.claimed > 0.02) & (each.of_candidate > 0) & each.candidates.has_surface
    own = is_known & ~np.isnan(each.candidates.matched)
    pairs = Pairs(each.candidates, evidence, scores)
    shows, matched = (np.stack([TERMS[name](pairs) for name in kind], 2) for kind in (FITTED.shows, FITTED.matched))
    return [(shows[near], is_right[near]), (matched[own], is_right[own])]


def leaf_samples(each: Study, candidates: Candidates, fitted: LeafScores) -> list[tuple[bool, np.ndarray, bool, float]]:
    """Of each candidate, as the choice met it: whether it has a surface, its features, whether it is a leaf that none
    before it is, and P."""
    samples, seen = [], set()
    for step in choose(candidates, each.table, drawn=each.drawn, fitted=fitted).steps:
        leaf = main_leaf(each.leaf[step.rows]) if len(step.rows) else -1
        if leaf != -2:
            is_right = leaf > 0 and leaf not in seen
            samples.append((bool(candidates.has_surface[step.candidate]), step.terms, is_right, step.chance))
        seen.add(leaf)
    return samples


def ceiling(each: Study, least: float) -> float:
    """MV-PQ of the best proposals."""
    best: dict[tuple[int, int], tuple[float, int]] = {}
    for row in ((each.table.detection_scores >= least).numpy() & (each.leaf > 0)).nonzero()[0].tolist():
        view, leaf = int(each.table.view_index[row]), int(each.leaf[row])
        x1, y1, x2, y2 = each.table.regions.boxes[row].tolist()
        inside = int((each.truth[view][y1:y2, x1:x2][each.table.regions.crop(row).numpy()] == leaf).sum())
        iou = inside / (int(each.table.regions.areas[row]) + int((each.truth[view] == leaf).sum()) - inside)
        if iou > best.get((view, leaf), (0.0, -1))[0]:
            best[view, leaf] = iou, row
    rows = [row for _, row in best.values()]
    ids = np.unique(each.leaf[rows], return_inverse=True)[1] + 1
    return leaf_metrics(each.table.regions.select(torch.tensor(rows)), torch.from_numpy(ids), each.truth).mv_pq


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--leave_out", action="store_true")
    parser.add_argument("--sizes", type=int, nargs="*", default=(), help="pixels of the longer side, besides the usual")
    args = parser.parse_args()
    warnings.simplefilter("ignore", InputWarning)
    looks = [(1, None), (2, None), *((1, size) for size in args.sizes)]
    found = [study(folder, step, size) for folder in args.scenes for step, size in looks]
    studies = [each for each in found if each is not None]
    plants = [each.name.rpartition("-")[2] for each in studies]
    part = {plant: number % PARTS for number, plant in enumerate(sorted(set(plants)))}
    numbers = dict.fromkeys(plants, FITTED)
    if args.leave_out:
        of_part = [
            fit([each for each, plant in zip(studies, plants, strict=True) if part[plant] != out])
            for out in range(PARTS)
        ]
        numbers = {plant: of_part[number] for plant, number in part.items()}
    names = "".join(f"{name:>8}" for name in ("MV-PQ", "snapped", "right", "false", *SCORES))
    print(f"{'scene':30}{names}")
    samples = []
    for plant, each in zip(plants, studies, strict=True):
        chosen = choose(each.candidates, each.table, drawn=each.drawn, fitted=numbers[plant])
        ids = torch.from_numpy(np.where(chosen.leaf >= 0, chosen.leaf + 1, -1))
        masks = replace(each.table, instance_ids=ids).select(ids > 0)
        before, score = (
            leaf_metrics(masks.regions, masks.instance_ids, each.truth)
            for masks in (masks, snap_masks(masks, each.photos))
        )
        ceilings = "".join(f"{ceiling(each, least):8.3f}" for least in SCORES)
        counts = f"{score.num_right:8}{score.num_false:8}"
        print(f"{each.name:30}{before.mv_pq:8.3f}{score.mv_pq:8.3f}{counts}{ceilings}", flush=True)
        samples += leaf_samples(each, each.candidates, numbers[plant])
    chances, is_right = np.array([each[3] for each in samples]), np.array([each[2] for each in samples])
    for low, high in pairwise(BINS):
        here = (chances >= low) & (chances < high)
        if here.any():
            print(f"P {low:.2f} to {high:.2f}: {here.sum():5} candidates, mean {chances[here].mean():.2f}, "
                  f"right {is_right[here].mean():.2f}")  # fmt: skip
    print("fitted on all of them:", fit(studies))


if __name__ == "__main__":
    main()
