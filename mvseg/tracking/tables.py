"""The tables of tracks, tidy; empty cells are missing numbers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path

from mvseg.formats.text_file import Cell, write_table
from mvseg.tracking.growth import Growth
from mvseg.tracking.track import Tracks

NODE_NUMBERS = ("node_height", "internode", "divergence", "insertion_angle")
COLUMNS = {
    "tracks.csv": ("plant", "time", "scene", "leaf", "track", "probability", "state"),
    "growth.csv": ("plant", "track", "trait", "time", "value", "sd", "unit", "rate", "rate_sd"),
    "plants.csv": (
        "plant", "time", "scene", "leaves", "born", "gone", "phyllochron", "total_area", "total_area_sd", "unit",
        "relative_growth_rate", "relative_growth_rate_sd",
    ),
    "nodes.csv": (
        "plant", "time", "scene", "stem", "node", "leaf", "track",
        *(name + end for name in NODE_NUMBERS for end in ("", "_sd")), "unit",
    ),
}  # fmt: skip


def write_track_tables(folder: Path, tracks: Tracks, growth: Growth) -> None:
    """Write the tables of one plant; `nodes.csv` has a row per date and node."""
    rows: dict[str, list[tuple[Cell, ...]]] = {name: [] for name in COLUMNS}

    def add(file: str, *values: Cell) -> None:
        rows[file].append((tracks.plant, *values))

    for row in tracks.rows:
        date = tracks.dates[row.date]
        add("tracks.csv", date.written, date.scene, row.leaf, row.track, round(row.probability, 4), row.state)
    for point in growth.points:
        number, time = point.number, tracks.dates[point.date].written
        measured = number.value, number.sd, number.unit, point.rate, point.rate_sd
        add("growth.csv", point.track, point.trait, time, *measured)
    for each in growth.plant:
        date, area, rate = tracks.dates[each.date], each.total_area, each.relative_growth_rate
        numbers = each.phyllochron, area.value, area.sd, area.unit, rate.value, rate.sd
        add("plants.csv", date.written, date.scene, each.leaves, each.born, each.gone, *numbers)
    track_of = {(row.date, row.leaf): row.track for row in tracks.rows if row.leaf is not None}
    for index, date in enumerate(tracks.dates):
        nodes = [(leaf.node, leaf.leaf, leaf.numbers) for leaf in date.leaves if leaf.node is not None]
        for node, leaf, own in sorted(nodes, key=lambda each: each[:2]):
            pairs = [(own[name].value, own[name].sd) if name in own else (None, None) for name in NODE_NUMBERS]
            add("nodes.csv", date.written, date.scene, *node, leaf, track_of[index, leaf], *chain(*pairs), date.unit)
    for name, columns in COLUMNS.items():
        write_table(folder / name, columns, rows[name])


def join_tables(folder: Path, parts: Sequence[Path]) -> None:
    """Move the tables of plants from their folders into one of each, one below the other; plants without any failed.
    One line is in memory at a time: an experiment may have thousands of plants."""
    for name in COLUMNS:
        is_first = True
        with (folder / name).open("wb") as whole:
            for path in (part / name for part in parts if (part / name).is_file()):
                with path.open("rb") as table:
                    whole.writelines(table if is_first else islice(table, 1, None))
                path.unlink()
                is_first = False
