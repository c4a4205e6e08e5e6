"""The tables of a batch: traits of all plants, the outcome of each scene, and the reasons of failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mvseg.batch.scene_list import SUMMARY_COLUMNS, BatchScene
from mvseg.batch.status import Status
from mvseg.formats.text_file import Cell, write_table
from mvseg.results.earlier import Output, replace_result
from mvseg.traits.table import COLUMNS, read_csv, wide_columns


def write_tables(
    folder: Path, out: Path, scenes: Sequence[tuple[BatchScene, Status]], *, run: Mapping[str, Any]
) -> None:
    """Write the folder of tables, whole or not at all; an earlier one is replaced, the user's files there stay. The
    results of the scenes that are done lie in `out`; `run` goes into run.json besides counts. Raises InputError if a
    result cannot be read, or `folder` cannot be replaced (see `replace_result`)."""
    carried = list(scenes[0][0].carried)
    done = [scene for scene, status in scenes if status.state == "done"]
    summary = [[scene.name, *scene.carried.values(), *_outcome(status)] for scene, status in scenes]
    failures = [(scene.name, str(scene.folder), status.sentence)
                for scene, status in scenes if status.state == "failed"]  # fmt: skip
    counts = {"scenes": len(scenes), "done": len(done), "failed": len(failures)}
    with replace_result(folder, {**run, "counts": counts}, Output("tables")) as partial:
        for name, columns in (("traits.csv", COLUMNS), ("traits_wide.csv", wide_columns())):
            _join(partial / name, columns, done, out, carried=carried)
        write_table(partial / "summary.csv", ["scene", *carried, *SUMMARY_COLUMNS], summary)
        write_table(partial / "failures.csv", ("scene", "folder", "sentence"), failures)


def _outcome(status: Status) -> tuple[Cell, ...]:
    counts = status.instances, status.masks, status.views, len(status.warnings)
    peak = "" if status.peak_mb is None else f"{status.peak_mb:.0f}"
    texts = " | ".join(status.warnings), status.sentence
    return status.state, *counts, f"{status.seconds:.1f}", peak, *texts


def _join(
    path: Path, columns: Sequence[str], scenes: Sequence[BatchScene], out: Path, *, carried: Sequence[str]
) -> None:
    shared = [column for column in columns if column not in carried]
    rows = [
        [scene.name, *scene.carried.values(), *(row[column] for column in shared)]
        for scene in scenes
        for row in read_csv(out / scene.name / path.name, columns)
    ]
    write_table(path, ["scene", *carried, *shared], rows)
