"""What `python -m benchmarks.speed` makes of its measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.speed.write_up import BEGIN, END, draw_plot, fit_slopes, table_lines, write_between


def record(cell: tuple[int, int, float], version: str, factor: float) -> dict[str, Any]:
    """A scene whose stages cost in proportion to what they work on."""
    views, leaves, megapixels = cell
    masks, labelled_px = views * leaves, 1e5 * megapixels
    pairs = views * (views - 1) / 2 * labelled_px
    cost = {"load": 0.1, "affinity": 1e-6 * pairs, "matching": 1e-3 * masks * views, "pictures": 0.2}
    seconds = {stage: [2 * factor * each, factor * each] for stage, each in cost.items()}
    counts = {"views": views, "masks": masks, "labelled_px": labelled_px, "matching_GB": 0.5, "ids": "abc"}
    return {"seconds": seconds, "cell": list(cell), "version": version, **counts}


CELLS = ((10, 16, 0.3), (5, 16, 0.3), (20, 16, 0.3), (10, 4, 0.3), (10, 16, 1.2))
NOW = [record(cell, "now", 1.0) for cell in CELLS]


def test_costs_in_proportion_have_slope_one() -> None:
    assert fit_slopes(NOW) == {"affinity": 1.0, "matching": 1.0, "pictures": 0.0}


def test_tables_show_both_versions_and_go_between_the_marks_of_a_page(tmp_path: Path) -> None:
    both = [*NOW, *(record(cell, "previous", 2.0) for cell in CELLS)]
    lines = table_lines(both, {"drawn lines": 55.0}, {"now": {"affinity": 1.0}})
    assert lines[2].startswith("| 10 | 16 | 0.3 | 160 | 0.10 / 0.20 |")
    assert lines[2].endswith("| 0.50 / 0.50 | same |")
    assert "| 10 views, 16 leaves, 0.3 Mpx | CPU s | wall s |" in lines
    assert "| drawn lines | 55 | |" in lines
    assert lines[-1] == "Slopes, now: affinity 1."
    page = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    written = write_between(page, lines)
    assert written.startswith(f"before\n{BEGIN}\n\n| views |")
    assert written.endswith(f"Slopes, now: affinity 1.\n\n{END}\nafter\n")
    assert write_between(written, lines) == written
    with pytest.raises(ValueError, match="once each"):
        write_between("no marks", lines)
    draw_plot(both, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000
