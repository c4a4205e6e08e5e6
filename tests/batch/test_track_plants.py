"""`mvseg track`: from results to tables and pages, written whole."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from batch_work import run_here
from benchmarks.tracking import true_ids
from csv_rows import read_rows
from mvseg import demo_scene
from mvseg.batch.track_plants import list_plants, track_plants
from mvseg.cli import main
from mvseg.cli.track import _name_plant
from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.formats.label_png import read_labels, write_label_png
from mvseg.tracking.dates import read_date
from mvseg.tracking.tables import COLUMNS
from tests.plants_over_days import grow_blades, grown, write_result

Said = pytest.CaptureFixture[str]
BLADES = grow_blades(7, 4)


def write_batch(folder: Path, rows: list[tuple[str, str, str]]) -> Path:
    """A batch with these (scene, plant, time) rows, all done; every scene shows its plant a little larger."""
    (folder / "tables").mkdir(parents=True)
    for index, (scene, _, _) in enumerate(rows):
        write_result(folder / scene, grown(BLADES, 1 + 0.05 * index))
    lines = ["scene,plant,time,state", *(f"{scene},{plant},{time},done" for scene, plant, time in rows)]
    (folder / "tables" / "summary.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_results_of_one_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, factor in (("a", 1.0), ("b", 1.1)):
        write_result(tmp_path / name, grown(BLADES, factor))
    out = tmp_path / "out"
    results = [str(tmp_path / "b"), str(tmp_path / "a")]  # in any order
    times = ["--times", "2026-03-05", "2026-03-01"]
    arguments = ["track", *results, *times, "--plant", "=basil", "--out", str(out), "--quiet"]
    assert main(arguments) == 0
    assert "7 leaves of 1 plant on 2 dates, 4 days apart\n" in capsys.readouterr().out
    rows = read_rows(out / "tracks.csv")
    assert list(rows[0]) == ["plant", "time", "scene", "leaf", "track", "probability", "state"]
    assert [(row["scene"], row["leaf"]) for row in rows if row["track"] == "3"] == [("a", "3"), ("b", "3")]
    assert {row["plant"] for row in rows} == {"'=basil"}  # no formula
    growth = [row for row in read_rows(out / "growth.csv") if row["track"] == "1" and row["trait"] == "length"]
    assert [row["time"] for row in growth] == ["2026-03-01", "2026-03-05"]
    first, second = (float(row["value"]) for row in growth)
    assert growth[0]["rate"] == ""  # the later of two dates has it
    assert float(growth[1]["rate"]) == pytest.approx((second - first) / 4, rel=1e-4)
    (before, after) = read_rows(out / "plants.csv")
    assert (before["leaves"], before["total_area"], before["unit"]) == ("7", "5000", "mm^2")
    assert float(after["relative_growth_rate"]) == pytest.approx(0.0238, abs=1e-3)  # ln 1.1 / 4 days
    run = json.loads((out / "run.json").read_text())
    assert set(run["files"]) == {*COLUMNS, "tracks.html"}
    page = (out / "tracks.html").read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=[\"']?https?:", page)
    (out / "notes.txt").write_text("mine")
    (tmp_path / "moved").mkdir()
    for name in ("a", "b", "out"):
        (tmp_path / name).rename(tmp_path / "moved" / name)
    again = tmp_path / "moved" / "out"
    edit = {"op": "different_track", "at": [["a", "000", 5.5, 20], ["b", "000", 5.5, 20]]}
    (again / "corrections.json").write_text(json.dumps({"format": "mvseg-corrections/1", "edits": [edit]}))
    assert main(["track", "--again", str(again), "--corrections", str(again / "corrections.json"), "--quiet"]) == 0
    assert (again / "notes.txt").read_text() == "mine"  # replaced, and the user's files stay
    assert (again / "corrections.json").is_file()
    assert len({row["track"] for row in read_rows(again / "tracks.csv")}) == 8
    assert main(["track", "--again", str(again), "--quiet"]) == 0  # with what was said before
    assert len({row["track"] for row in read_rows(again / "tracks.csv")}) == 8
    assert {row["time"] for row in read_rows(again / "tracks.csv")} == {"2026-03-01", "2026-03-05"}


def test_each_result_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch, read_files = write_batch(tmp_path / "batch", [("a0", "a", "0"), ("a1", "a", "1")]), list[Path]()

    def read_and_note(path: Path, content: Any) -> Any:
        read_files.append(path)
        return read_json(path, content)

    monkeypatch.setattr("mvseg.results.read.read_json", read_and_note)
    track_plants(list_plants(batch)[0], tmp_path / "out")
    assert read_files == [batch / scene / "instances.json" for scene in ("a0", "a1")]
    page = (tmp_path / "out" / "tracks.html").read_text(encoding="utf-8")
    assert len(re.findall(r'"crop": ?"/9j/', page)) == 2 * len(BLADES)  # a JPEG of each leaf


def test_all_plants_of_a_batch(tmp_path: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvseg.batch.track_plants.run_locally", run_here)
    rows = [("a0", "a", "0"), ("b0", "b", "0"), ("a1", "a", "1"), ("b1", "b", ""), ("c0", "c", "0")]
    batch = write_batch(tmp_path / "batch", rows)
    assert main(["track", str(batch), "--out", str(tmp_path / "out"), "--quiet", "--num_workers", "2"]) == 3
    said = capsys.readouterr().err
    assert "1 plants have one date and are left out" in said
    assert "plant b: b1 has no time" in said
    assert {row["plant"] for row in read_rows(tmp_path / "out" / "tracks.csv")} == {"a"}
    assert {path.name for path in (tmp_path / "out" / "plants" / "00001").iterdir()} == {"tracks.html"}
    assert 'href="plants/00001/tracks.html"' in (tmp_path / "out" / "tracks.html").read_text()


def test_tables_of_many_plants_are_those_of_each_one_below_the_other(tmp_path: Path) -> None:
    rows = [(f"{plant}{day}", plant, str(day)) for plant in "ab" for day in (0, 1)]
    batch = write_batch(tmp_path / "batch", rows)
    track_plants(list_plants(batch)[0], tmp_path / "all", report=False)
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == [
        "growth.csv", "nodes.csv", "plants.csv", "run.json", "tracks.csv",
    ]  # fmt: skip
    for plant in list_plants(batch)[0]:
        track_plants([plant], tmp_path / plant.plant, report=False)
    for name in COLUMNS:
        one, other = (read_rows(tmp_path / plant / name) for plant in "ab")
        assert read_rows(tmp_path / "all" / name) == one + other


@pytest.mark.slow
def test_the_two_dates_that_ship(tmp_path: Path) -> None:
    """The quick start, with half of the leaves: another pot, other cameras, one leaf gone, one new."""
    dates = []
    for name, place in (("day-0", demo_scene()), ("day-6", demo_scene().with_name("demo_plant_later"))):
        shutil.copytree(place, tmp_path / name)
        for path in (tmp_path / name / "truth").glob("*.png"):
            labels = read_labels(path)
            write_label_png(
                tmp_path / name / "masks" / path.name,
                np.where((labels % 2 == 1) | (labels == 2), labels, 0).astype(np.uint16),
            )
        out = str(tmp_path / "results" / name)
        assert main(["infer", str(tmp_path / name), "--masks", "masks", "--out", out, "--report", "false"]) == 0
        dates.append(out)
    assert main(["track", *dates, "--times", "0", "6", "--out", str(tmp_path / "tracks"), "--quiet"]) == 0
    truths = {
        Path(date).name: true_ids(read_date(Path(date), 0), tmp_path / Path(date).name / "truth") for date in dates
    }
    tracks: dict[str, list[int]] = {}
    for row in read_rows(tmp_path / "tracks" / "tracks.csv"):
        if row["leaf"]:
            tracks.setdefault(row["track"], []).append(truths[row["scene"]][int(row["leaf"]) - 1])
    assert sorted(tracks.values()) == [[1, 1], [2], [3, 3], [5, 5], [7, 7], [9, 9], [11, 11], [13]]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two whole results, and one without shapes."""
    folder = tmp_path_factory.mktemp("results")
    for name in ("a", "b", "ids"):
        write_result(folder / name, BLADES)
    for name in ("traits.csv", "surfaces.npz"):
        (folder / "ids" / name).unlink()
    (folder / "ids" / "run.json").write_text('{"format": 2}')
    return folder


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a", "a"], "2 results are given without --times"),
        (["a", "--times", "1", "2"], "1 results have 2 times"),
        (["a", "b", "--times", "1", "1"], "have the same time 1"),
        ([], "no results are given"),
        (["--again", "a"], "holds no tracks.csv and run.json"),
        (["--again", "a", "--pots", "fixed"], "with its results, times and pots"),
        (["a", "b", "--times", "1", "soon"], "expected a number .days. or an ISO date"),
        (["a"], "is not an output of mvseg batch"),
        (["a", "ids", "--times", "1", "2"], "has ids but no surfaces, run mvseg infer"),
    ],
)
def test_bad_input_gets_one_sentence(
    arguments: list[str], said: str, results: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(results)
    assert main(["track", *arguments, "--out", "out", "--quiet"]) == 2
    error = capsys.readouterr().err.strip()
    assert re.search(said, error)
    assert len(error.splitlines()) == 1
    assert not (results / "out").exists()


def test_a_batch_without_two_dates_is_refused(tmp_path: Path) -> None:
    batch = write_batch(tmp_path / "batch", [("a0", "a", "0"), ("b0", "b", "0")])
    with pytest.raises(InputError, match="no plant has two finished dates"):
        list_plants(batch)


def test_the_growth_model_of_the_docs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [str(tmp_path / f"day-{day}") for day in range(6)]
    sizes = [1 / (1 + np.exp(-0.8 * (day - 2))) for day in range(6)]
    few = {leaf: BLADES[leaf] for leaf in range(1, 5)}
    for name, size in zip(names, sizes, strict=True):
        write_result(Path(name), grown(few, float(0.7 + 0.3 * size)))
    times = [str(day) for day in range(6)]
    assert main(["track", *names, "--times", *times, "--out", str(tmp_path / "tracks"), "--quiet"]) == 0
    assert capsys.readouterr().out.endswith(f"mvseg: look at: {tmp_path / 'tracks' / 'tracks.html'}\n")
    fit = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "recipes" / "growth.py"))["main"]
    fit(tmp_path / "tracks" / "growth.csv")
    assert len(re.findall(r"^tracks \d+ \[", capsys.readouterr().out, re.MULTILINE)) == 4


def test_a_plant_has_the_name_of_its_scenes_where_results_are_named_after_dates(tmp_path: Path) -> None:
    for day, scene in (("day-0", "demo_plant"), ("day-6", "demo_plant_later")):
        (tmp_path / day).mkdir()
        (tmp_path / day / "run.json").write_text(json.dumps({"format": 2, "scene": f"/plants/{scene}"}), "utf-8")
    assert _name_plant([tmp_path / "day-0", tmp_path / "day-6"]) == "demo_plant"
