"""The tables of a batch: traits of all plants, the outcome of each scene, and the reasons of failures."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mvseg.batch.places import SUMMARY_COLUMNS, scene_result
from mvseg.batch.scene_list import BatchScene
from mvseg.batch.status import Status
from mvseg.errors import InputError
from mvseg.results.earlier import RUN_FILE, check_out, keep_user_files, list_files
from mvseg.system.atomic import folder_whole
from mvseg.traits.table import escape_text, write_csv


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
    with folder_whole(folder) as partial:
        for name in ("traits.csv", "traits_wide.csv"):
            _join(partial / name, done, out, carried=carried)
        _write_summary(partial / "summary.csv", scenes, carried)
        failures = [
            [scene.name, str(scene.folder), escape_text(status.sentence)]
            for scene, status in scenes
            if status.state == "failed"
        ]
        write_csv(partial / "failures.csv", ("scene", "folder", "sentence"), failures)
        counts = {"scenes": len(scenes), "done": len(done), "failed": len(failures)}
        text = json.dumps({**run, "counts": counts, "files": list_files(partial)}, indent=1, default=str)
        (partial / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        keep_user_files(folder, partial)


def _join(path: Path, scenes: Sequence[BatchScene], out: Path, *, carried: Sequence[str]) -> None:
    """Join the tables of the scenes; the first columns are the scene and its cells of the batch's table."""
    columns: list[str] = []
    rows: list[list[str | int]] = []
    for scene in scenes:
        source = scene_result(out, scene.name) / path.name
        try:
            with source.open(newline="", encoding="utf-8") as file:
                found, *lines = csv.reader(file)
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(f"{source}: cannot be read ({error}), expected the table of a result") from None
        kept = [index for index, column in enumerate(found) if column not in carried]
        if columns and [found[index] for index in kept] != columns:
            raise InputError(f"{source}: has other columns than the results before it")
        columns = [found[index] for index in kept]
        about = [_cell(scene.name), *(_cell(text) for text in scene.carried.values())]
        rows += [[*about, *(line[index] for index in kept)] for line in lines]
    write_csv(path, ["scene", *carried, *columns], rows)


def _write_summary(path: Path, scenes: Sequence[tuple[BatchScene, Status]], carried: Sequence[str]) -> None:
    rows: list[list[str | int]] = []
    for scene, status in scenes:
        counts: list[str | int] = [status.instances, status.masks, status.views, len(status.warnings)]
        peak = "" if status.peak_mb is None else f"{status.peak_mb:.0f}"
        texts = [escape_text(" | ".join(status.warnings)), escape_text(status.sentence)]
        about = [_cell(scene.name), *(_cell(text) for text in scene.carried.values())]
        rows.append([*about, status.state, *counts, f"{status.seconds:.1f}", peak, *texts])
    write_csv(path, ["scene", *carried, *SUMMARY_COLUMNS], rows)


def _cell(text: str) -> str:
    """Text that no spreadsheet evaluates as a formula; numbers stay numbers, negative ones, too."""
    try:
        return text if math.isfinite(float(text)) else escape_text(text)
    except ValueError:
        return escape_text(text)
