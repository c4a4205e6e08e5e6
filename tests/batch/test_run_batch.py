"""A night's plants: what is done, kept, refused and told."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from batch_work import run_here
from csv_rows import read_rows
from mvseg.batch.run_batch import BatchCounts, run_batch
from mvseg.batch.status import read_status, scene_state
from mvseg.batch.workers import Lost
from mvseg.cli import main
from mvseg.cli.command import build_parser
from mvseg.cli.options import build_run
from mvseg.config import RunConfig
from mvseg.errors import InputError
from mvseg.findings.finding import Finding
from mvseg.results.read import read_instances
from mvseg.system.atomic import lock_folder
from scene_folders import write_scene

Said = pytest.CaptureFixture[str]
COARSE = ["--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500", "--report", "false"]


@pytest.fixture
def plants(tmp_path: Path) -> Path:
    """Two scenes, and one whose cameras are broken."""
    for name, num_views in (("basil", 3), ("mint", 2)):
        write_scene(tmp_path / "plants" / name, num_views)
    write_scene(tmp_path / "plants" / "cactus", 2)
    (tmp_path / "plants" / "cactus" / "cameras.json").write_text("{")
    return tmp_path / "plants"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in this process."""
    monkeypatch.setattr("mvseg.batch.run_batch.run_locally", run_here)


def arguments(scenes: Path, out: Path, *more: str) -> list[str]:
    return ["batch", str(scenes), "--masks", "masks", "--out", str(out), *COARSE, *more]


@pytest.mark.slow
def test_a_broken_scene_does_not_stop_the_others(
    plants: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    out = tmp_path / "out"
    assert main(arguments(plants, out, "--num_workers", "2")) == 3
    said = capsys.readouterr()
    assert said.out == f"{out}: 2 of 3 scenes are done\n"
    reason = f"{plants / 'cactus' / 'cameras.json'}: not a whole JSON file"
    assert f"\rmvseg: cactus: {reason}" in said.err
    assert "batch: scene 1 of 3" in said.err
    assert ", basil" in said.err
    assert f"mvseg: 1 of 3 scenes failed, see {out / 'tables' / 'failures.csv'}\n" in said.err
    assert sorted(path.name for path in out.iterdir()) == ["_batch", "basil", "mint", "tables"]
    (failure,) = read_rows(out / "tables" / "failures.csv")
    assert (failure["scene"], failure["folder"]) == ("cactus", str(plants / "cactus"))
    assert failure["sentence"].startswith(reason)
    assert len(read_instances(out / "basil", plants / "basil" / "truth")[0]) == 9
    environment = read_status(scene_state(out, "basil"))
    assert environment is not None
    assert environment.peak_mb is None or environment.peak_mb > 50


def test_the_tables_of_a_batch(here: None, plants: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, out = tmp_path / "night.csv", tmp_path / "out"
    table.write_text("scene,plant,time,pot\nplants/basil,=b1,-2,red\nplants/mint,m1,day 3,@2\nplants/nowhere,n1,,\n")
    assert main(arguments(table, out, "--quiet", "--unit", "cm")) == 3
    said = capsys.readouterr().err.splitlines()
    assert f"mvseg: plants_nowhere: {tmp_path / 'plants' / 'nowhere'}: no such scene folder" in said
    assert f"mvseg: warning: 2 of 2 scenes have warnings, see {out / 'tables' / 'summary.csv'}" in said
    single = read_rows(out / "plants_basil" / "traits.csv")
    joined = read_rows(out / "tables" / "traits.csv")
    assert list(joined[0])[:5] == ["scene", "plant", "time", "pot", "leaf"]
    basil = [row for row in joined if row["scene"] == "plants_basil"]
    assert {(row["plant"], row["time"], row["pot"]) for row in basil} == {("'=b1", "-2", "red")}
    assert {(row["plant"], row["pot"]) for row in joined if row not in basil} == {("m1", "'@2")}
    own = ["leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology"]
    assert [[row[name] for name in own] for row in basil] == [[row[name] for name in own] for row in single]
    wide = read_rows(out / "tables" / "traits_wide.csv")
    assert [(row["scene"], row["leaf"]) for row in wide] == [
        (scene, str(leaf)) for scene in ("plants_basil", "plants_mint") for leaf in (1, 2, 3)
    ]
    assert list(wide[0])[:6] == ["scene", "plant", "time", "pot", "leaf", "use"]  # plant once, as the list has it
    summary = read_rows(out / "tables" / "summary.csv")
    columns = ("scene", "plant", "state", "instances", "masks", "views", "warnings", "warning_text")
    warning = str(Finding("unit_only_renamed", values={"before": "mm", "unit": "cm"}))
    far = summary[1]["warning_text"].partition(" | ")[2]
    assert far.startswith("2 views (000, 001): the next view is up to 98 degrees away")
    assert [[row[name] for name in columns] for row in summary] == [
        ["plants_basil", "'=b1", "done", "3", "9", "3", "1", warning],
        ["plants_mint", "m1", "done", "3", "6", "2", "2", f"{warning} | {far}"],
        ["plants_nowhere", "n1", "failed", "0", "0", "0", "0", ""],
    ]
    run = json.loads((out / "tables" / "run.json").read_text())
    assert run["counts"] == {"scenes": 3, "done": 2, "failed": 1}
    assert run["config"]["unit"] == "cm"
    assert run["files"].keys() == {path.name for path in (out / "tables").iterdir()} - {"run.json"}


def test_a_batch_is_resumed(here: None, plants: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(arguments(plants, out, "--quiet")) == 3
    tables = {path.name: path.read_bytes() for path in (out / "tables").glob("*.csv")}
    (out / "tables" / "notes.txt").write_text("a good night")
    capsys.readouterr()
    assert main(arguments(plants, out, "--quiet")) == 2
    message = f"mvseg: error: {out}: holds an earlier batch, expected --resume true or another --out\n"
    assert capsys.readouterr().err == message
    assert main(arguments(plants, out, "--quiet", "--resume", "true")) == 3
    assert capsys.readouterr().out == f"{out}: 2 of 3 scenes are done (2 of them before)\n"
    again = {path.name: path.read_bytes() for path in (out / "tables").glob("*.csv")}
    assert again | {"summary.csv": b""} == tables | {"summary.csv": b""}
    (plants / "cactus" / "cameras.json").write_bytes((plants / "mint" / "cameras.json").read_bytes())
    assert main(arguments(plants, out, "--quiet", "--resume", "true")) == 0
    assert capsys.readouterr().out == f"{out}: 3 of 3 scenes are done (2 of them before)\n"
    assert read_rows(out / "tables" / "failures.csv") == []
    assert (out / "tables" / "notes.txt").read_text() == "a good night"
    (out / "tables" / "traits.csv").write_text("scene,corrected\n")
    assert main(arguments(plants, out, "--quiet", "--resume", "true")) == 2
    assert "traits.csv: was changed after mvseg wrote it, move it away" in capsys.readouterr().err


def test_parts_of_a_batch_share_its_folder(here: None, plants: Path, tmp_path: Path, capsys: Said) -> None:
    """They write no tables; a last run keeps what they did, tries again what failed, and writes the tables."""
    out = tmp_path / "out"
    assert main(arguments(plants, tmp_path / "whole", "--quiet")) == 3
    capsys.readouterr()
    assert main(arguments(plants, out, "--quiet", "--part", "2/2")) == 3  # cactus
    with lock_folder(out):  # whoever has the whole batch hinders no part
        assert main(arguments(plants, out, "--quiet", "--part", "1/2")) == 0
    assert capsys.readouterr().out == f"{out}: 0 of 1 scenes are done\n{out}: 2 of 2 scenes are done\n"
    assert sorted(path.name for path in out.iterdir()) == ["_batch", "basil", "mint"]
    assert main(arguments(plants, out, "--quiet", "--resume", "true")) == 3
    assert capsys.readouterr().out == f"{out}: 2 of 3 scenes are done (2 of them before)\n"
    for name in ("traits.csv", "traits_wide.csv", "failures.csv"):
        assert (out / "tables" / name).read_bytes() == (tmp_path / "whole" / "tables" / name).read_bytes()


def test_a_scene_whose_worker_dies_gets_one_more_try_alone(
    plants: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rounds = []

    def run(work: Any, items: Any, started: Any, *, num_workers: int) -> Iterator[tuple[int, Any]]:
        rounds.append([item.name for item in items.values()])
        for key, item in items.items():
            started(key)
            dies = item.name == "basil" or (item.name == "mint" and len(items) > 1)
            yield key, Lost("was killed") if dies else work(item)

    monkeypatch.setattr("mvseg.batch.run_batch.run_locally", run)
    assert main(arguments(plants, tmp_path / "out", "--quiet", "--num_workers", "3")) == 3
    assert rounds == [["basil", "cactus", "mint"], ["basil"], ["mint"]]
    said = capsys.readouterr().err
    assert "mvseg: mint: the process was killed; it is tried again\n" in said
    sentence = "the process that worked on this scene was killed, twice"
    assert f"mvseg: basil: {sentence}\n" in said
    failures = {row["scene"]: row["sentence"] for row in read_rows(tmp_path / "out" / "tables" / "failures.csv")}
    assert failures["basil"] == sentence
    assert failures.keys() == {"basil", "cactus"}
    status = read_status(scene_state(tmp_path / "out", "basil"))
    assert status is not None
    assert (status.state, status.sentence) == ("failed", sentence)


@pytest.mark.slow
def test_a_worker_that_is_killed_for_good(plants: Path, tmp_path: Path) -> None:
    if not Path("/proc/self/status").exists():
        pytest.skip("looks for the workers in /proc")
    out, killed = tmp_path / "out", []

    def kill() -> None:
        state = scene_state(out.resolve(), "basil")
        while len(killed) < 2 and not stop.wait(0.002):
            status = read_status(state)
            if status is None or status.state != "running":
                continue
            for children in Path("/proc/self/task").glob("*/children"):
                with suppress(OSError):  # threads and processes come and go
                    for process in map(int, children.read_text().split()):
                        if b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes():
                            os.kill(process, signal.SIGKILL)
                            killed.append(process)
            (state / "status.json").unlink(missing_ok=True)

    stop = threading.Event()
    thread = threading.Thread(target=kill)
    thread.start()
    try:
        (plants / "cactus").rename(tmp_path / "cactus")
        counts = run_batch(plants, out, masks=Path("masks"))
    finally:
        stop.set()
        thread.join()
    assert counts == BatchCounts(done=1, resumed=0, failed=1, warned=1)  # of mint, whose two views are far apart
    (failure,) = read_rows(out / "tables" / "failures.csv")
    sentence = "the process that worked on this scene died, most likely because memory ran out, twice"
    assert failure["sentence"] == sentence
    assert sorted(path.name for path in out.iterdir()) == ["_batch", "mint", "tables"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--num_workers", "0"], "num_workers is 0, expected at least 1"),
        (["--part", "3"], "--part is '3', expected K/N, as 3/20"),
        (["--part", "0/2"], "part is 0/2, expected K/N with K from 1 to N"),
        (["--match.num_points", "0"], "num_points is 0"),
        (["--masks", "null", "--detect.weights", "no.safetensors"], "'no.safetensors' is neither a shipped detector"),
    ],
)
def test_bad_options(more: list[str], message: str, plants: Path, tmp_path: Path, capsys: Said) -> None:
    assert main(arguments(plants, tmp_path / "out", *more)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_options_are_those_of_infer(tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text("match: {seed: 4}\nunit: cm\ncategories: leaf\n")
    words = ["--config", str(tmp_path / "run.yaml"), "--detect.min_score", "0.4", "--reconstruct.shape", "voxels"]
    words += ["--traits.leaves_only", "false", "--scale", "2", "--up", "0 0 1"]
    words += ["--coco_crowd", "ignore", "--report", "false"]
    words += ["--views", "12", "--learn", "2", "--stem_category", "stem"]
    infer, both = (build_run(build_parser().parse_args([verb, "x", *words])[verb]) for verb in ("infer", "batch"))
    assert infer == both
    assert (both.match.seed, both.unit, both.scale, both.up) == (4, "cm", 2, (0, 0, 1))
    names, usual = [field.name for field in fields(RunConfig)], RunConfig()
    assert [name for name in names if getattr(both, name) == getattr(usual, name)] == []


def test_an_out_that_is_no_batch_is_left_alone(plants: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").touch()
    with pytest.raises(InputError, match="holds files that are not a batch, expected a new or empty folder"):
        run_batch(plants, out, resume=True)
    with pytest.raises(InputError, match="is a file, expected a folder for the results"):
        run_batch(plants, out / "thesis.txt")
    assert [path.name for path in out.iterdir()] == ["thesis.txt"]


def test_two_batches_on_one_folder(plants: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "_batch").mkdir(parents=True)
    with (
        lock_folder(out),
        pytest.raises(InputError, match="another run is writing to this folder, expected one at a time"),
    ):
        run_batch(plants, out, resume=True)


def test_the_folder_of_scenes_may_hold_the_results(here: None, plants: Path) -> None:
    (plants / "cactus" / "cameras.json").unlink()
    shutil.rmtree(plants / "basil")
    out = plants / "results"
    assert main(arguments(plants, out, "--quiet")) == 3
    assert main(arguments(plants, out, "--quiet", "--resume", "true")) == 3
    assert [row["scene"] for row in read_rows(out / "tables" / "summary.csv")] == ["cactus", "mint"]
