"""The tables of tracks: tidy, with text that no spreadsheet takes for a formula; empty cells are missing numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mvseg.tracking.growth import fit_curves, growth_points, plant_rows
from mvseg.tracking.track import Tracks
from mvseg.traits.table import escape_text, format_number, write_csv

Row = list[str | int]
COLUMNS = {
    "tracks.csv": ("plant", "time", "scene", "leaf", "track", "probability", "state"),
    "growth.csv": ("plant", "track", "trait", "time", "value", "sd", "unit", "rate", "rate_sd"),
    "plants.csv": (
        "plant", "time", "scene", "leaves", "born", "gone", "phyllochron", "total_area", "total_area_sd", "unit",
        "relative_growth_rate", "relative_growth_rate_sd", "divergence_angles",
    ),
    "curves.csv": (
        "plant", "track", "trait", "model", "size", "size_sd", "rate", "rate_sd", "middle", "middle_sd", "residual",
    ),
}  # fmt: skip


def table_rows(tracks: Tracks) -> dict[str, list[Row]]:
    """{file: rows} of one plant, as in COLUMNS."""
    return {
        "tracks.csv": _track_rows(tracks),
        "growth.csv": _growth_rows(tracks),
        "plants.csv": _plant_rows(tracks),
        "curves.csv": _curve_rows(tracks),
    }


def write_tables(folder: Path, rows: Mapping[str, Sequence[Row]]) -> None:
    """Write the four tables."""
    for name, columns in COLUMNS.items():
        write_csv(folder / name, columns, rows[name])


def _time(tracks: Tracks, date: int) -> str:
    return (
        escape_text(tracks.dates[date].written)
        if not _is_plain(tracks.dates[date].written)
        else (tracks.dates[date].written)
    )


def _is_plain(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _track_rows(tracks: Tracks) -> list[Row]:
    plant = escape_text(tracks.plant)
    return [
        [
            plant, _time(tracks, row.date), escape_text(tracks.dates[row.date].scene),
            "" if row.leaf is None else row.leaf, row.track,
            f"{row.probability:.4f}" if row.probability == row.probability else "", row.state,
        ]
        for row in tracks.rows
    ]  # fmt: skip


def _growth_rows(tracks: Tracks) -> list[Row]:
    plant = escape_text(tracks.plant)
    return [
        [
            plant, point.track, point.trait, _time(tracks, point.date), format_number(point.number.value),
            format_number(point.number.sd), escape_text(point.number.unit), format_number(point.rate),
            format_number(point.rate_sd),
        ]
        for point in growth_points(tracks)
    ]  # fmt: skip


def _plant_rows(tracks: Tracks) -> list[Row]:
    plant = escape_text(tracks.plant)
    return [
        [
            plant, _time(tracks, row.date), escape_text(tracks.dates[row.date].scene), row.leaves, row.born, row.gone,
            format_number(row.phyllochron), format_number(row.total_area.value), format_number(row.total_area.sd),
            escape_text(row.total_area.unit), format_number(row.relative_growth_rate.value),
            format_number(row.relative_growth_rate.sd), " ".join(f"{angle:g}" for angle in row.divergence),
        ]
        for row in plant_rows(tracks)
    ]  # fmt: skip


def _curve_rows(tracks: Tracks) -> list[Row]:
    plant = escape_text(tracks.plant)
    return [
        [
            plant, curve.track, curve.trait, curve.model, format_number(curve.size), format_number(curve.sds[0]),
            format_number(curve.rate), format_number(curve.sds[1]), format_number(curve.middle),
            format_number(curve.sds[2]), format_number(curve.residual),
        ]
        for curve in fit_curves(tracks)
    ]  # fmt: skip
