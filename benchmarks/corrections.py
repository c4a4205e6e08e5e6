"""How far answers bring a result: `python -m benchmarks.corrections --cache DIR --scenes BASIL ...`

A simulated person (`simulated_person.py`) answers the page's questions about what the detector finds in the photos of a
scene, in rounds, and the stages of `mvseg infer --corrections` run again after each. A question that no answer fits
counts nothing. And harm: leaves that were right, that no answer of the round was about, and that are wrong after it.
Scenes are folders with photos and `truth/`.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.choice import true_maps
from benchmarks.simulated_person import Labels, Look, choose_answers, list_answers
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections, Edit
from mvseg.corrections.mask_questions import list_mask_questions
from mvseg.detection.cached_detections import CachedDetections
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import Plant
from mvseg.regions import IGNORE_LABEL
from mvseg.simulation.dataset import PRESETS, SceneSpec, scene_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene

RATES = (0.0, 0.25, 0.5, 1.0, 2.0)  # answers per leaf
ROUNDS = 8
MEASURES = ("MV-PQ", "leaves right")


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with the masks that a person corrects.

    Attributes:
        plant: what is known before edits.
        truth: V label maps.
    """

    plant: Plant
    truth: Sequence[Labels]

    @property
    def num_leaves(self) -> int:
        return len(set(np.unique(np.concatenate([np.unique(each) for each in self.truth]))) - {0, IGNORE_LABEL})


def detect_case(folder: Path, config: RunConfig, *, cache: Path | None = None) -> Case:
    """A scene whose leaves the detector finds."""
    kept = None if cache is None else CachedDetections(cache)
    plant = find_in_photos(open_scene(folder, None, config), cache=kept)
    return Case(plant, true_maps(folder, plant.scene))


def render(spec: SceneSpec, cache: Path) -> Path:
    """The folder of a scene with photos, written when it is not in the cache."""
    folder = cache / "scenes" / f"{spec.seed}" / spec.folder
    if not folder.exists():
        plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
        write_scene(folder, plant, scene_cameras(spec, plant, PRESETS["paper-eval"]), seed=spec.seed)
    return folder


# --- rounds


def correct(case: Case) -> tuple[list[tuple[int, float, float]], int]:
    """After each round the number of answers, MV-PQ and the share of leaves that is right; and the leaves harmed."""
    rounds, harmed, edits, done = [], 0, tuple[Edit, ...](), set[str]()
    right, touched = frozenset[int](), frozenset[int]()  # leaves, after the last round, and that its answers are about
    most = math.ceil(RATES[-1] * case.num_leaves)
    while True:
        result = shape_leaves(apply_edits(case.plant, Corrections(edits)))
        masks = result.masks.to("cpu")
        doubts = list_mask_questions(masks, result.surfaces, cameras=result.scene.cameras, rejected=result.rejected)
        look = Look(masks, case.truth, result.scene, doubts)
        whole = leaf_metrics(masks.regions, masks.instance_ids, case.truth)
        rounds.append((len(done), whole.mv_pq, whole.num_right / max(whole.num_right + whole.num_missed, 1)))
        harmed += len(right - look.right - touched)
        step = min(most - len(done), math.ceil(most / ROUNDS))
        chosen = choose_answers(list_answers(look, edits), most=step, done=done)
        if not chosen:
            return rounds, harmed
        right, touched = look.right, frozenset[int]().union(*(each.leaves for each in chosen))
        edits += tuple(edit for each in chosen for edit in each.edits)
        done |= {each.name for each in chosen}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for detections")
    parser.add_argument("--scenes", nargs="+", type=Path, required=True, help="folders with photos and truth/")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    print("| answers per leaf | " + " | ".join(f"{rate:g}" for rate in RATES) + " | leaves harmed |\n|" + "---|" * 7)
    rows = []
    for folder in args.scenes:
        case = detect_case(folder, RunConfig(), cache=args.cache / folder.name)
        rounds, harmed = correct(case)
        reached = [[each for each in rounds if each[0] <= rate * case.num_leaves][-1] for rate in RATES]
        rows.append((np.array(reached)[:, 1:], harmed, rounds[-1][0]))
        print_rows(folder.name, *rows[-1])
    figures, harmed, answers = zip(*rows, strict=True)
    print_rows("mean", np.mean(figures, axis=0), sum(harmed), sum(answers))


def print_rows(name: str, reached: NDArray[np.float64], harmed: int, answers: int) -> None:
    for measure, values in zip(MEASURES, reached.T, strict=True):
        cells = " | ".join(f"{value:.3f}" for value in values)
        print(f"| {name}: {measure} | {cells} | {harmed} by {answers} answers |", flush=True)


if __name__ == "__main__":
    main()
