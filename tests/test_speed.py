"""What `python -m benchmarks.speed` makes of its measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import benchmarks.speed.__main__ as speed
from benchmarks.speed.write_up import draw_plot, fit_slopes, growth_lines, threads_lines, write_all, write_between


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
THREADS = [record(CELLS[0], "now", 1.0 / threads) | {"threads": threads} for threads in (1, 2)]
MARKS = {
    name: [f"<!-- {side}: benchmarks.speed, {name} -->" for side in ("begin", "end")] for name in ("growth", "threads")
}


def test_costs_in_proportion_have_slope_one() -> None:
    assert fit_slopes(NOW) == {"affinity": 1.0, "matching": 1.0, "pictures": 0.0}


def test_the_growth_shows_both_versions(tmp_path: Path) -> None:
    both = [*NOW, *(record(cell, "previous", 2.0) for cell in CELLS)]
    lines = growth_lines(both, {"now": {"affinity": 1.0}})
    assert lines[2].startswith("| 10 | 16 | 0.3 | 160 | 0.10 / 0.20 |")
    assert lines[2].endswith("| 0.50 / 0.50 | same |")
    assert lines[-1] == "Slopes, now: affinity 1."
    draw_plot(both, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000


def test_threads_stand_side_by_side() -> None:
    """Of the version before, one thread only."""
    lines = threads_lines([*THREADS, record(CELLS[0], "previous", 2.0) | {"threads": 1}], {"drawn lines": 55.0})
    assert lines[0].startswith("| 10 views, 16 leaves, 0.3 Mpx | CPU s, one thread | wall s, one thread | wall s, two")
    assert lines[2] == "| load | 0.1 / 0.2 | 0.2 / 0.4 | 0.1 |"
    assert lines[-1] == "| drawn lines | 55 | | |"


def test_tables_go_between_the_marks_of_a_page() -> None:
    begin, end = MARKS["growth"]
    page = f"before\n{begin}\nold\n{end}\nafter\n"
    written = write_between(page, ["new"], name="growth")
    assert written == f"before\n{begin}\n\nnew\n\n{end}\nafter\n"
    assert write_between(written, ["new"], name="growth") == written
    with pytest.raises(ValueError, match="once each"):
        write_between(page, ["new"], name="threads")


def test_threads_alone_leave_the_growth_as_it_stands(tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    page.write_text("\n\n".join(mark for marks in MARKS.values() for mark in marks), encoding="utf-8")
    write_all(tmp_path, NOW, THREADS, {"drawn lines": 55.0})
    before = json.loads((tmp_path / "performance.json").read_text())
    growth = page.read_text().split(MARKS["threads"][0])[0]
    assert "Slopes, now" in growth
    write_all(tmp_path, [], [THREADS[0], THREADS[1] | {"seconds": THREADS[0]["seconds"]}], {"drawn lines": 66.0})
    after = json.loads((tmp_path / "performance.json").read_text())
    assert page.read_text().startswith(growth)
    assert "| load | 0.1 | 0.2 | 0.2 |" in page.read_text()
    assert "drawn lines | 66" in page.read_text()
    assert {key for key in before if before[key] != after[key]} == {"threads", "rivals"}


def test_threads_take_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each round: the stages with one and two threads, then the commands; the previous version in one thread."""
    said = []

    def run_cell(scene: Path, checkout: Path, *, threads: int, every: bool) -> dict[str, Any]:
        said.append(("stages", checkout.name, threads))
        assert every
        return {"seconds": {"load": [len(said), 2.0]}, "ids": "abc"}

    def run_shell(verb: str, checkout: Path, *, threads: int) -> tuple[float, float]:
        said.append((verb, checkout.name, threads))
        return 1.0, 2.0

    monkeypatch.setattr(speed, "make_scene", lambda cell, cache: cache)
    monkeypatch.setattr(speed, "run_cell", run_cell)
    monkeypatch.setattr(speed, "run_shell", run_shell)
    versions = {"now": tmp_path / "new", "previous": tmp_path / "old"}
    records = speed.measure_threads(versions, rounds=2, cache=tmp_path)
    kinds = [("new", 1), ("new", 2), ("old", 1)]
    assert said == [(what, *kind) for what in ("stages", "match", "infer") for kind in kinds] * 2
    assert [(each["version"], each["threads"]) for each in records] == [("now", 1), ("now", 2), ("previous", 1)]
    assert records[1]["seconds"] == {"load": [6.5, 2.0], "mvseg match": [1.0, 2.0], "mvseg infer": [1.0, 2.0]}


def test_processes_are_told_how_many_threads_they_have(tmp_path: Path) -> None:
    environment = speed.make_environment(tmp_path, 2)
    assert environment["PYTHONPATH"] == str(tmp_path)
    assert {environment[name] for name in environment if name in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")} == {"2"}
