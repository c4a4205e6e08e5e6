"""Traits as tables that pandas and spreadsheets open.

A cell of text that a spreadsheet would run as a formula gets an apostrophe in front. Empty cells are missing numbers.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, UNKNOWN_UNIT, VOXEL_TRAITS, unit_of

COLUMNS = ("plant", "leaf", "trait", "value", "sd", "unit", "method", "ontology")
FORMULA_STARTS = ("=", "+", "-", "@")
VOXEL_NAMES = {trait.name for trait in VOXEL_TRAITS}


def write_long(path: Path, traits: Traits) -> None:
    """One row per trait: those of the plant, whose leaf is empty, then those of each leaf.

    In the row of a missing number, `method` is the reason. Leaves without voxels have no rows for these.
    """
    rows = [_row(traits, name, number, leaf="") for name, number in traits.whole.items()]
    for leaf in traits.leaves:
        for name, number in leaf.numbers.items():
            if number.exists or name not in VOXEL_NAMES:
                rows.append(_row(traits, name, number, leaf=leaf.leaf))
    write_csv(path, COLUMNS, rows)


def write_wide(path: Path, traits: Traits) -> None:
    """One row per leaf: each trait, beside it its standard deviation, and in the end the unit of lengths, the method
    and the quality: "good", or the reasons to doubt the numbers."""
    write_csv(path, wide_columns(), [_wide_row(traits, leaf) for leaf in traits.leaves])


def wide_columns() -> list[str]:
    """The columns of `write_wide`."""
    columns = ["leaf"]
    for trait in LEAF_TRAITS:
        if trait.name != "quality":
            columns += [trait.name, f"{trait.name}_sd"] if trait.has_sd else [trait.name]
    return [*columns, "iou", "unit", "method", "quality"]


def _row(traits: Traits, name: str, number: Measurement, *, leaf: int | str) -> list[str | int]:
    definition = DEFINITIONS[name]
    unit = unit_of(definition.kind, traits.unit)
    method, ontology = number.method, definition.ontology
    return [
        escape_text(traits.plant), leaf, name, format_number(number.value), format_number(number.sd),
        escape_text(unit), escape_text(method), ontology,
    ]  # fmt: skip


def _wide_row(traits: Traits, leaf: LeafTraits) -> list[str | int]:
    cells: list[str | int] = [leaf.leaf]
    for trait in LEAF_TRAITS:
        if trait.name != "quality":
            number = leaf.numbers[trait.name]
            cells.append(format_number(number.value))
            if trait.has_sd:
                cells.append(format_number(number.sd))
    unit = escape_text(traits.unit or UNKNOWN_UNIT)
    method, quality = escape_text(leaf.method), escape_text("; ".join(leaf.reasons) or "good")
    return [*cells, format_number(leaf.numbers["quality"].value), unit, method, quality]


def format_number(value: float) -> str:
    """Six significant digits; "" for what is not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""


def escape_text(text: str) -> str:
    """Text in one line that no spreadsheet takes for a formula."""
    text = " ".join(text.split())
    return f"'{text}" if text.startswith(FORMULA_STARTS) else text


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str | int]]) -> None:
    """Columns, then rows, as UTF-8."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
