"""How far few corrections bring a result: `python benchmarks/corrections.py --out DIR --cache DIR [--scenes BASIL]`

A simulated person (`simulated_person.py`) corrects a scene in rounds, and the stages of `mvseg infer --corrections` run
again after each. He makes the edits that repair most ("repair"), or answers the page's questions in their order
("ask"). An outline that he draws counts 3, any other edit 1, and so does an answer, whatever edits its key makes; a
question that no answer fits counts nothing. Beside it, the same edits to the masks of the first result alone: what the
cameras bring is the difference. And harm: leaves that were right, that no edit of the round was about, and that are
wrong after it. Of "degraded" masks (`label_maps.py`) the
ids are corrected, as `mvseg match` gives them; "detected" are the same scenes from pixels; --scenes are folders with
photos and `truth/`. Rounds that are in the folder are not run again.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import math
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.choice import true_maps
from benchmarks.label_maps import add_scene_options, chosen_scenes, load_maps
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
from mvseg.corrections.apply import APPLIED
from mvseg.corrections.doubtful import list_doubts
from mvseg.corrections.file import Corrections, Edit, load_corrections, write_corrections
from mvseg.detection.cached_detections import CachedDetections
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_leaves import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.known import Known, match_given
from mvseg.pipeline.open_scene import Opened, open_scene
from mvseg.regions import IGNORE_LABEL
from mvseg.results.result import Result
from mvseg.scene import Scene, View
from mvseg.simulation.dataset import PRESETS, SceneSpec, scene_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene
from mvseg.system.atomic import write_text_whole
from mvseg.system.running import running

Record = dict[str, Any]

MOST, ROUNDS = 2.0, 8  # edits' worth per leaf, and in how many rounds, as a rule
ORDERS: tuple[Order, ...] = ("repair", "ask")
CURVES = (
    ("corrected, what repairs most first", "repair", "", "C2-"),
    ("the page's questions answered", "ask", "", "C0-"),
    ("the same edits, masks alone", "repair", "alone_", "C7--"),
)
PANELS = (
    ("degraded", "ari", "ARI of the ids"),
    ("detected", "right", "leaves right"),
    ("detected", "mv_pq", "MV-PQ of whole leaves"),
)
MEASURES = ("ari", "pair_f1", "mv_pq", "right")
NEARLY_ALL = 0.95  # of the leaves right: the aim, with an edit's worth for two leaves


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with the masks that a person corrects.

    Attributes:
        name: of its files.
        known: what is known before edits.
        truth: V label maps.
        has_masks: they were given.
    """

    name: str
    known: Known
    truth: Sequence[Labels]
    has_masks: bool

    @property
    def num_leaves(self) -> int:
        return len(set(np.unique(np.concatenate([np.unique(each) for each in self.truth]))) - {0, IGNORE_LABEL})


def list_cases(args: argparse.Namespace) -> Iterator[Case]:
    for spec in chosen_scenes(args) if "degraded" in args.masks else ():
        yield degraded_case(spec, args.cache)
    folders = [render(spec, args.cache) for spec in chosen_scenes(args)] if "detected" in args.masks else []
    for folder in [*folders, *args.scenes]:
        yield detect_case(folder, RunConfig(), cache=args.cache / "kept" / folder.name)


def detect_case(folder: Path, config: RunConfig, *, cache: Path | None = None) -> Case:
    """A scene whose leaves the detector finds."""
    kept = None if cache is None else CachedDetections(cache)
    known = find_in_photos(open_scene(folder, None, config), cache=kept)
    return Case(f"detected_{folder.name}", known, true_maps(folder, known.scene), has_masks=False)


def degraded_case(spec: SceneSpec, cache: Path) -> Case:
    maps = load_maps(spec, cache)
    regions, config = maps.masks("degraded")[0], RunConfig(reconstruct=None)
    name = Path(spec.folder).name
    views = tuple(View(f"{view:03d}", Path(f"{name}/{view:03d}.png")) for view in range(len(maps.cameras)))
    scene = Scene(name=name, views=views, cameras=maps.cameras, unit="mm", up=(0.0, 0.0, 1.0))
    given = Masks.of(regions)
    opened = Opened(scene, Photos(scene), given, mask_kind="label images", views_left_out=(), config=config)
    return Case(f"degraded_{name}", match_given(opened), list(maps.true), has_masks=True)


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
    """ARI of the masks that show a leaf, and, of whole leaves: pair F1, MV-PQ and the share that is right."""
    shown = shown_instances(masks.regions, truth)
    is_leaf = (shown > 0) & (shown != IGNORE_LABEL)
    whole = leaf_metrics(masks.regions, masks.instance_ids, truth)
    return {
        "ari": matching_metrics(masks.instance_ids[is_leaf], shown[is_leaf]).ari,
        "pair_f1": whole.all_pair_f1,
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
        look = Look(masks, case.truth, result.scene, doubts, ids_only=case.has_masks)
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


def along(records: Sequence[Record], name: str, rates: np.ndarray) -> np.ndarray:
    """A measure at all these rates, on straight lines from round to round."""
    return np.interp(rates, [each["worth"] / each["leaves"] for each in records], [each[name] for each in records])


def print_table(runs: Sequence[Sequence[Record]]) -> None:
    """For each scene, what is reached with none, a quarter, half and one edit's worth for each leaf; and the means."""
    rates = (0.0, 0.25, 0.5, 1.0, MOST)
    print(f"{'edits worth, per leaf (masks alone)':68}" + "".join(f"{rate:8.2f}{'':8}" for rate in rates))
    orders = sorted({str(run[0]["order"]) for run in runs})
    kinds = sorted({str(run[0]["scene"]).split("_")[0] for run in runs})
    groups = [[run] for run in runs]
    for kind, order in itertools.product(kinds, orders):
        alike = [run for run in runs if run[0]["order"] == order and str(run[0]["scene"]).startswith(kind)]
        groups += [alike] if len(alike) > 1 else []
    for group in groups:
        about = str(group[0][0]["scene"]) if len(group) == 1 else f"mean of {len(group)}, {group[0][0]['scene']}"
        for measure in MEASURES:
            cells = ""
            for rate in rates:
                value, alone = (
                    np.mean([at_rate(run, f"{of}{measure}", rate) for run in group]) for of in ("", "alone_")
                )
                cells += f"{value:8.3f} ({alone:.3f})"
            print(f"{about[:46]:47} {group[0][0]['order']:12} {measure:8}{cells}")
        when = [min((each["worth"] for each in run if each["right"] >= NEARLY_ALL), default=None) for run in group]
        shown = ", ".join(
            f"{w or 0:.0f} of {run[0]['leaves']:.0f}" if w is not None else "never"
            for w, run in zip(when, group, strict=True)
        )
        harmed = sum(each["harmed"] for run in group for each in run)
        edits = sum(run[-1]["edits"] for run in group)
        print(f"{'':47} {NEARLY_ALL:.0%} of the leaves right with edits worth {shown}; "
              f"{harmed:.0f} leaves harmed by {edits:.0f} edits")  # fmt: skip


def plot(runs: Sequence[Sequence[Record]], path: Path) -> None:
    """Means over the scenes of each kind, over edits' worth per leaf."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    panels = [each for each in PANELS if any(str(run[0]["scene"]).startswith(each[0]) for run in runs)]
    figure, axes = pyplot.subplots(1, len(panels), figsize=(3.3 * len(panels), 3), sharey=True, squeeze=False)
    rates = np.linspace(0, max(run[-1]["worth"] / run[0]["leaves"] for run in runs), 61)
    for axis, (kind, measure, title) in zip(axes[0], panels, strict=True):
        of_kind = [run for run in runs if str(run[0]["scene"]).startswith(kind)]
        for name, order, prefix, style in CURVES:
            chosen = [run for run in of_kind if run[0]["order"] == order]
            if chosen:
                mean = np.mean([along(run, prefix + measure, rates) for run in chosen], 0)
                axis.plot(rates, mean, style, label=name, lw=1.6)
        axis.set_ylim(0.4, 1.01)
        axis.grid(alpha=0.3)
        scenes = len({run[0]["scene"] for run in of_kind})
        axis.set_title(f"{title}\n{kind} masks, {scenes} scene{'s' if scenes > 1 else ''}", fontsize=9)
        axis.set_xlabel("edits' worth per leaf", fontsize=9)
    axes[0][0].legend(fontsize=7, loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder for records and edits")
    parser.add_argument("--masks", nargs="*", choices=("degraded", "detected"), default=["degraded"])
    parser.add_argument("--scenes", nargs="*", type=Path, default=[], help="scene folders with photos and truth/")
    parser.add_argument("--orders", nargs="+", choices=ORDERS, default=["repair", "ask"])
    parser.add_argument("--plot", type=Path, help="draw the curves of all records in --out")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    with running(keep=True):
        for case in list_cases(args):
            for order in args.orders:
                correct(case, order, args.out)
    runs = [read_records(path) for path in sorted(args.out.glob("*.csv"))]
    print_table(runs)
    if args.plot is not None:
        plot(runs, args.plot)


if __name__ == "__main__":
    main()
