"""What is run on every cell, and where its records are."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.label_maps import plant_index
from benchmarks.paper_tables.cells import PRESETS, Cell, Record, keep_record, open_cell, read_cell, read_record
from benchmarks.paper_tables.masks import Masks, degraded_masks, detected_masks, true_masks
from benchmarks.paper_tables.methods import METHODS, score_method
from benchmarks.paper_tables.number_of_leaves import score_numbers
from benchmarks.paper_tables.shapes import SHAPES, measure_shape
from mvseg.detection.config import DetectConfig
from mvseg.detectors.zoo import find_weights
from mvseg.simulation.dataset import SceneSpec

TABLES = ("1", "2", "3", "k")


@dataclass(frozen=True)
class Plan:
    """What to run.

    Attributes:
        preset: a key of `PRESETS`.
        cache: folder for scenes and records.
        tables: of `TABLES`.
        detector: a detector whose masks are matched, too; None for none.
        real: folders of real scenes.
    """

    preset: str
    cache: Path
    tables: tuple[str, ...] = TABLES
    detector: str | None = None
    real: tuple[Path, ...] = ()

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of masks."""
        return ("true", "degraded", *([f"detected by {Path(self.detector).name}"] if self.detector else []))

    @property
    def records(self) -> Path:
        """Folder of the records of simulated scenes: <table>/<kind of masks>/<method>/<cell>.json."""
        return self.cache / "records" / self.preset

    def match_records(self, kind: str) -> Path:
        """Folder of the records of matching, by method; `hash_detector` distinguishes detectors."""
        detector = f"-{hash_detector(self.detector)}" if self.detector and kind.startswith("detected") else ""
        return self.records / "match" / f"{slug(kind)}{detector}"


def run_simulated(spec: SceneSpec, plan: Plan) -> None:
    """Make the missing records of one simulated scene."""
    wanted = [path for path, _ in list_records(spec, plan)]
    if all(path.is_file() for path in wanted):
        return
    cell = open_cell(spec, PRESETS[plan.preset], plan.cache)
    masks = functools.cache(partial(make_masks, cell, plan))  # each kind is made once
    for path, make in list_records(spec, plan):
        keep_record(path, partial(make, cell, masks))


def run_real(folder: Path, plan: Plan) -> None:
    """Make the missing records of one real scene, matched with its true masks."""
    cell = read_cell(folder, folder.resolve().name, {})
    masks = functools.cache(partial(make_masks, cell, plan))  # each kind is made once
    for method in METHODS:
        path = real_record(plan, folder, method)
        keep_record(path, partial(score_kind, cell, masks, kind="true", method=method, cache=plan.cache))


MaskSource = Callable[[str], Masks]  # the masks of a kind
Maker = Callable[[Cell, MaskSource], Record]


def list_records(spec: SceneSpec, plan: Plan) -> Iterator[tuple[Path, Maker]]:
    """The path of every record that the plan wants of a scene, and the function that makes it from the cell and its
    masks by kind."""
    file = spec.folder.replace("/", "_") + ".json"
    if "1" in plan.tables:
        for kind in plan.kinds:
            for method in METHODS:
                path = plan.match_records(kind) / slug(method) / file
                yield path, partial(score_kind, kind=kind, method=method, cache=plan.cache)
    if "k" in plan.tables:
        for kind in ("true", "degraded"):
            path = plan.records / "numbers" / slug(kind) / file
            yield path, partial(score_numbers_of, kind=kind)
    if "3" in plan.tables and plant_index(spec) == 0:
        for name in SHAPES:
            path = plan.records / "shapes" / slug(name) / file
            yield path, partial(measure_shape, name=name, cache=plan.cache)


def score_kind(cell: Cell, masks: MaskSource, *, kind: str, method: str, cache: Path) -> Record:
    return score_method(cell, masks(kind), method, cache=cache)


def score_numbers_of(cell: Cell, masks: MaskSource, *, kind: str) -> Record:
    return score_numbers(cell, masks(kind))


def read_records(folder: Path, specs: list[SceneSpec]) -> list[Record]:
    """The records in a folder of `list_records` so far, with the axes of their scenes."""
    records = []
    for spec in specs:
        path = folder / (spec.folder.replace("/", "_") + ".json")
        if path.is_file():
            axes = {"scene": spec.folder, "leaves": spec.num_leaves, "views": spec.num_views, "family": spec.family}
            records.append(axes | read_record(path))
    return records


def real_record(plan: Plan, folder: Path, method: str) -> Path:
    return plan.cache / "records" / "real" / folder.resolve().name / f"{slug(method)}.json"


def make_masks(cell: Cell, plan: Plan, kind: str) -> Masks:
    if kind == "true":
        return true_masks(cell)
    if kind == "degraded":
        return degraded_masks(cell)
    assert plan.detector is not None
    return detected_masks(cell, plan.detector)


@functools.cache
def hash_detector(detector: str) -> str:
    """First digits of the SHA-256 of a detector's weights (no bytes when there is no such file) and its least score."""
    path = find_weights(detector) or Path(detector)
    weights = path.read_bytes() if path.is_file() else b""
    return hashlib.sha256(weights + str(DetectConfig.min_score).encode()).hexdigest()[:8]


def slug(name: str) -> str:
    """A name as part of a path: letters, digits, dots and dashes."""
    words = "".join(letter if letter.isalnum() or letter == "." else " " for letter in name.lower()).split()
    return "-".join(words)
