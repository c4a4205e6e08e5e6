"""How far few corrections bring a result: `python benchmarks/corrections.py --out DIR --scenes BASIL ...`

A simulated person (`simulated_person.py`) corrects what the detector finds in the photos of a scene, in rounds, and the
stages of `mvseg infer --corrections` run again after each. He makes the edits that repair most ("repair"), or answers
the page's questions in their order ("ask"). An outline that he draws counts 3, any other edit 1, and so does an answer,
whatever edits its key makes; a question that no answer fits counts nothing. Beside it, the same edits to the masks of
the first result alone: what the cameras bring is the difference. And harm: leaves that were right, that no edit of the
round was about, and that are wrong after it. Scenes are folders with photos and `truth/`. Rounds that are in the folder
are not run again.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.choice import true_maps
from benchmarks.masks_alone import change_masks_alone
from benchmarks.simulated_person import (
    Labels,
    Look,
    Order,
    choose_repairs,
    count_worth,
    list_answers,
    list_repairs,
)
from mvseg.config import RunConfig
from mvseg.corrections.corrected import APPLIED
from mvseg.corrections.doubtful import list_doubts
from mvseg.corrections.file import Corrections, Edit, load_corrections, write_corrections
from mvseg.detection.cached_detections import CachedDetections
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.masks import Masks
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.known import Known
from mvseg.pipeline.open_scene import open_scene
from mvseg.regions import IGNORE_LABEL
from mvseg.results.result import Result
from mvseg.simulation.dataset import PRESETS, SceneSpec, scene_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene
from mvseg.system.atomic import write_text_whole
from mvseg.system.running import running

Record = dict[str, Any]

MOST, ROUNDS = 2.0, 8  # edits' worth per leaf, and in how many rounds, as a rule
ORDERS: tuple[Order, ...] = ("repair", "ask")
MEASURES = ("mv_pq", "right")


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with the masks that a person corrects.

    Attributes:
        name: of its files.
        known: what is known before edits.
        truth: V label maps.
    """

    name: str
    known: Known
    truth: Sequence[Labels]

    @property
    def num_leaves(self) -> int:
        return len(set(np.unique(np.concatenate([np.unique(each) for each in self.truth]))) - {0, IGNORE_LABEL})


def detect_case(folder: Path, config: RunConfig, *, cache: Path | None = None) -> Case:
    """A scene whose leaves the detector finds."""
    kept = None if cache is None else CachedDetections(cache)
    known = find_in_photos(open_scene(folder, None, config), cache=kept)
    return Case(f"detected_{folder.name}", known, true_maps(folder, known.scene))


def render(spec: SceneSpec, cache: Path) -> Path:
    """The folder of a scene with photos, written when it is not in the cache."""
    folder = cache / "scenes" / f"{spec.seed}" / spec.folder
    if not folder.exists():
        plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
        write_scene(folder, plant, scene_cameras(spec, plant, PRESETS["paper-eval"]), seed=spec.seed)
    return folder


# --- rounds


def compute(case: Case, corrections: Corrections) -> Result:
    """What a run makes of the scene with these corrections, without traits."""
    return shape_leaves(apply_edits(case.known, corrections))


def judge(masks: Masks, truth: Sequence[Labels]) -> dict[str, float]:
    """MV-PQ of whole leaves, and the share of the leaves that is right."""
    whole = leaf_metrics(masks.regions, masks.instance_ids, truth)
    return {
        "mv_pq": whole.mv_pq,
        "right": whole.num_right / max(whole.num_right + whole.num_missed, 1),
    }


def correct(case: Case, order: Order, out: Path) -> list[Record]:
    """The records of all rounds, until edits are worth `MOST` for each leaf; those in the folder are read."""
    path = out / f"{case.name}_{order}.csv"
    records, edits = read_records(path), tuple[Edit, ...]()
    if records and records[-1]["is_last"]:
        return records
    if records:
        edits = load_corrections(path.with_suffix(".json")).edits
    first = compute(case, Corrections()).masks.to("cpu") if edits else None
    right, touched = frozenset[int](), frozenset[int]()  # leaves, after the round before, and that its edits are about
    while True:
        begun = time.process_time()
        result = compute(case, Corrections(edits))
        seconds = time.process_time() - begun
        masks = result.masks.to("cpu")
        first = masks if first is None else first
        doubts = list_doubts(masks, result.surfaces, cameras=result.scene.cameras, left=result.left)
        look = Look(masks, case.truth, result.scene, doubts)
        listed = list_answers(look, edits) if order == "ask" else list_repairs(look)
        done = {str(edit.by) for edit in edits}
        most = math.ceil(MOST * case.num_leaves)
        left = most - count_worth(edits)
        step = min(left, math.ceil(most / ROUNDS))
        chosen = choose_repairs(listed, order=order, worth=(step, left), done=done)
        about = {"scene": case.name, "order": order, "leaves": case.num_leaves}
        alone = judge(change_masks_alone(first, edits, result.scene), case.truth)
        record = about | {"edits": len(edits), "worth": count_worth(edits)} | judge(masks, case.truth)
        record |= {f"alone_{name}": value for name, value in alone.items()}
        record["harmed"] = len(right - look.right - touched)
        right, touched = look.right, frozenset[int]().union(*(each.leaves for each in chosen))
        record |= {"idle": sum(fate.fate != APPLIED for fate in result.fates), "seconds": round(seconds, 1)}
        records.append(record | {"is_last": int(not chosen)})
        for each in chosen:
            edits += tuple(edit.model_copy(update={"by": each.name}) for edit in each.edits)
        write_corrections(path.with_suffix(".json"), Corrections(edits))
        write_records(path, records)
        print(describe(record), [each.name for each in chosen], flush=True)
        if not chosen:
            return records


def read_records(path: Path) -> list[Record]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [{k: v if k in ("scene", "order") else float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def write_records(path: Path, records: Sequence[Record]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    write_text_whole(path, text.getvalue())


# --- tables and curves


def describe(record: Record) -> str:
    """One line: what corrections reach, and in brackets the same edits to the masks alone."""
    figures = "  ".join(f"{name} {record[name]:.3f} ({record[f'alone_{name}']:.3f})" for name in MEASURES)
    return (
        f"{record['scene']:44} {record['order']:12} worth {record['worth']:3.0f}  {figures}  {record['seconds']:.0f} s"
    )


def at_rate(records: Sequence[Record], name: str, rate: float) -> float:
    """A measure after so many edits' worth per leaf: of the last round that had no more."""
    within = [each for each in records if each["worth"] <= rate * each["leaves"] + 1e-9]
    return float(within[-1][name])


def print_table(runs: Sequence[Sequence[Record]]) -> None:
    """For each scene, what is reached with none, a quarter, half and one edit's worth for each leaf; and the means."""
    rates = (0.0, 0.25, 0.5, 1.0, MOST)
    print(f"{'edits worth, per leaf (masks alone)':68}" + "".join(f"{rate:8.2f}{'':8}" for rate in rates))
    groups = [[run] for run in runs]
    alike = [[run for run in runs if run[0]["order"] == order] for order in ORDERS]
    groups += [group for group in alike if len(group) > 1]
    for group in groups:
        about = str(group[0][0]["scene"]) if len(group) == 1 else f"mean of {len(group)}"
        for measure in MEASURES:
            cells = ""
            for rate in rates:
                value, alone = (
                    np.mean([at_rate(run, f"{of}{measure}", rate) for run in group]) for of in ("", "alone_")
                )
                cells += f"{value:8.3f} ({alone:.3f})"
            print(f"{about[:46]:47} {group[0][0]['order']:12} {measure:8}{cells}")
        harmed = sum(each["harmed"] for run in group for each in run)
        edits = sum(run[-1]["edits"] for run in group)
        print(f"{'':47} {harmed:.0f} leaves harmed by {edits:.0f} edits")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for records and edits")
    parser.add_argument("--scenes", nargs="+", type=Path, required=True, help="folders with photos and truth/")
    parser.add_argument("--orders", nargs="+", choices=ORDERS, default=["repair", "ask"])
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    with running(keep=True):
        for folder in args.scenes:
            case = detect_case(folder, RunConfig(), cache=args.out / "kept" / folder.name)
            for order in args.orders:
                correct(case, order, args.out)
    print_table([read_records(path) for path in sorted(args.out.glob("*.csv"))])


if __name__ == "__main__":
    main()
