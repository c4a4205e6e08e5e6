"""Traits as tables that pandas and spreadsheets open.

A cell of text that a spreadsheet would run as a formula gets an apostrophe in front. Empty cells are missing numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import MappingProxyType

import numpy as np

from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import Traits
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, UNKNOWN_UNIT, VOXEL_TRAITS, unit_of

COLUMNS = ("plant", "leaf", "trait", "value", "sd", "unit", "method", "ontology")
FORMULA_STARTS = ("=", "+", "-", "@")
NUMBER = re.compile(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", re.IGNORECASE)
VOXEL_NAMES = {trait.name for trait in VOXEL_TRAITS}
WIDE_TRAITS = [trait for trait in LEAF_TRAITS if trait.name != "quality"]


def write_long(path: Path, traits: Traits) -> None:
    """One row per trait: those of the plant, whose leaf is empty, then those of each leaf.

    In the row of a missing number, `method` is the reason. Leaves without voxels have no rows for these.
    """
    rows = []
    tables: list[tuple[str | int, Mapping[str, Measurement]]] = [("", traits.whole)]
    for leaf, numbers in [*tables, *((leaf.leaf, leaf.numbers) for leaf in traits.leaves)]:
        for name, number in numbers.items():
            if number.exists or name not in VOXEL_NAMES:
                trait = DEFINITIONS[name]
                about = unit_of(trait.kind, traits.unit), number.method, trait.ontology
                rows.append(as_cells(traits.plant, leaf, name, number.value, number.sd, *about))
    write_csv(path, COLUMNS, rows)


def write_wide(path: Path, traits: Traits, probabilities: Mapping[int, float] = MappingProxyType({})) -> None:
    """One row per leaf: each trait, beside it its standard deviation, and in the end the unit of lengths, the method,
    the quality: "good", or the reasons to doubt the numbers; and how likely it is a leaf, where the views chose it."""
    rows = []
    for leaf in traits.leaves:
        numbers: list[float] = []
        for trait in WIDE_TRAITS:
            number = leaf.numbers[trait.name]
            numbers += [number.value, number.sd] if trait.has_sd else [number.value]
        texts = traits.unit or UNKNOWN_UNIT, leaf.method, "; ".join(leaf.reasons) or "good"
        rows.append(
            as_cells(leaf.leaf, *numbers, leaf.numbers["quality"].value, *texts, probabilities.get(leaf.leaf))
        )
    write_csv(path, wide_columns(), rows)


def wide_columns() -> list[str]:
    """The columns of `write_wide`."""
    pairs = [[trait.name, f"{trait.name}_sd"] if trait.has_sd else [trait.name] for trait in WIDE_TRAITS]
    return ["leaf", *chain.from_iterable(pairs), "iou", "unit", "method", "quality", "probability"]


def as_cells(*values: str | float | None) -> list[str | int]:
    """Whole numbers as they are, other numbers by `format_number`, text by `escape_text`, None as ""."""
    return [
        escape_text(value) if isinstance(value, str)
        else value if isinstance(value, int)
        else "" if value is None
        else format_number(value)
        for value in values
    ]  # fmt: skip


def format_number(value: float) -> str:
    """Six significant digits; "" for what is not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""


def escape_text(text: str) -> str:
    """Text in one line that no spreadsheet takes for a formula; numbers stay numbers, also negative ones."""
    text = " ".join(text.split())
    return f"'{text}" if text.startswith(FORMULA_STARTS) and not NUMBER.fullmatch(text) else text


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str | int]]) -> None:
    """Columns, then rows, as UTF-8."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
