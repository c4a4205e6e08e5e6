"""Averages over cells, as in the paper's tables, and Markdown tables of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.paper_tables.cells import Record

Pick = Callable[[Record], float | None]


@dataclass(frozen=True)
class Average:
    """Mean of a measure over cells; a cell is a number of leaves and a number of cameras, and counts once.

    Attributes:
        value: mean over the cells of the mean over their plants; None when no scene has a value.
        answered: number of scenes with a value.
        asked: number of scenes.
    """

    value: float | None
    answered: int
    asked: int

    def text(self, decimals: int) -> str:
        """The value, with the number of scenes behind it when some have none; "N/A" when all have none; "-" without
        scenes."""
        if self.value is None:
            return "N/A" if self.asked else "-"
        part = "" if self.answered == self.asked else f" ({self.answered} of {self.asked})"
        return f"{self.value:.{decimals}f}{part}"


def average(records: Iterable[Record], pick: Pick) -> Average:
    """The average of the values that `pick` takes from the records; None = no value."""
    cells = defaultdict(list)
    asked = 0
    for record in records:
        asked += 1
        value = pick(record)
        if value is not None:
            cells[record["leaves"], record["views"]].append(value)
    answered = sum(len(values) for values in cells.values())
    means = [float(np.mean(values)) for values in cells.values()]
    return Average(float(np.mean(means)) if means else None, answered, asked)


def average_columns(
    records: Sequence[Record], pick: Pick, *, views: Sequence[int], leaves: Sequence[int], leaves_at: int | None = None
) -> list[Average]:
    """One average per number of cameras, then one per number of leaves (with `leaves_at` cameras only), then all."""
    for_leaves = [record for record in records if leaves_at in (None, record["views"])]
    columns = [average([r for r in records if r["views"] == number], pick) for number in views]
    columns += [average([r for r in for_leaves if r["leaves"] == number], pick) for number in leaves]
    return [*columns, average(records, pick)]


def measure(*keys: str) -> Pick:
    """Picks `record[key][key]...`; None where the record, or the part of it that is asked for, is not applicable."""

    def pick(record: Record) -> float | None:
        value: Record | float = record
        for key in keys:
            if not isinstance(value, dict) or "na" in value:
                return None
            value = value[key]
        return None if isinstance(value, dict) else value

    return pick


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows]]
    return "\n".join(lines)
