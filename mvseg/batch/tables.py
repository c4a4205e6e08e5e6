"""The tables of a batch: traits of all plants, the outcome of each scene, and the reasons of failures."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mvseg.batch.scene_list import SUMMARY_COLUMNS, BatchScene
from mvseg.batch.status import Status
from mvseg.errors import InputError
from mvseg.results.earlier import RUN_FILE, check_out, keep_user_files, list_files
from mvseg.system.atomic import folder_whole
from mvseg.traits.table import as_cells, write_csv


def write_tables(
    folder: Path, out: Path, scenes: Sequence[tuple[BatchScene, Status]], *, run: Mapping[str, Any]
) -> None:
    """Write the folder of tables, whole or not at all; an earlier one is replaced, the user's files there stay.

    Args:
        folder: of the tables.
        out: where the results of the scenes that are done lie.
        scenes: all scenes with their outcomes, in the order of the rows.
        run: what goes into run.json besides counts.

    Raises:
        InputError: a result cannot be read, or `folder` cannot be replaced (see `check_out`).
        OSError: it cannot be written.
    """
    check_out(folder)
    carried = list(scenes[0][0].carried)
    done = [scene for scene, status in scenes if status.state == "done"]
    summary = [[*_about(scene), *_outcome(status)] for scene, status in scenes]
    failures = [as_cells(scene.name, str(scene.folder), status.sentence)
                for scene, status in scenes if status.state == "failed"]  # fmt: skip
    with folder_whole(folder) as partial:
        for name in ("traits.csv", "traits_wide.csv"):
            _join(partial / name, done, out, carried=carried)
        write_csv(partial / "summary.csv", ["scene", *carried, *SUMMARY_COLUMNS], summary)
        write_csv(partial / "failures.csv", ("scene", "folder", "sentence"), failures)
        counts = {"scenes": len(scenes), "done": len(done), "failed": len(failures)}
        text = json.dumps({**run, "counts": counts, "files": list_files(partial)}, indent=1, default=str)
        (partial / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        keep_user_files(folder, partial)


def _about(scene: BatchScene) -> list[str | int]:
    """The first cells of a row: the scene and its cells of the batch's table."""
    return as_cells(scene.name, *scene.carried.values())


def _outcome(status: Status) -> list[str | int]:
    counts = status.instances, status.masks, status.views, len(status.warnings)
    peak = "" if status.peak_mb is None else f"{status.peak_mb:.0f}"
    texts = " | ".join(status.warnings), status.sentence
    return as_cells(status.state, *counts, f"{status.seconds:.1f}", peak, *texts)


def _join(path: Path, scenes: Sequence[BatchScene], out: Path, *, carried: Sequence[str]) -> None:
    """Join the tables of the scenes, behind the cells of the batch's table."""
    columns: list[str] = []
    rows: list[list[str | int]] = []
    for scene in scenes:
        source = out / scene.name / path.name
        try:
            with source.open(newline="", encoding="utf-8") as file:
                found, *lines = csv.reader(file)
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(f"{source}: cannot be read ({error}), expected the table of a result") from None
        kept = [index for index, column in enumerate(found) if column not in carried]
        if columns and [found[index] for index in kept] != columns:
            raise InputError(f"{source}: has other columns than the results before it")
        columns = [found[index] for index in kept]
        rows += [[*_about(scene), *(line[index] for index in kept)] for line in lines]
    write_csv(path, ["scene", *carried, *columns], rows)
