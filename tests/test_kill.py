"""Runs that are killed at random moments: what is there is whole, old or new, and the next run works.

`MVSEG_KILLS=30 pytest tests/test_kill.py` kills each verb that often (`make fuzz` does).
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from signal import SIGKILL, SIGTERM
from typing import Any

import pytest

from batch_work import run_here
from mvseg.cli import main
from mvseg.detectors.weights_file import read_weights
from mvseg.results.read import read_instances
from mvseg.system.atomic import sweep_abandoned
from mvseg.system.file_hash import hash_files
from mvseg.training.state import read_checkpoint
from scene_folders import write_scene
from tiny_training import write_photos

KILLS = int(os.environ.get("MVSEG_KILLS", "1"))  # of each verb
SAID = "mvseg: stopped by SIGTERM"

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="runs are forked")


class Runs:
    """Runs of the command in processes of their own, one after another."""

    def __init__(self, folder: Path) -> None:
        root = Path(__file__).parent
        path = os.pathsep.join([str(root.parent), str(root), os.environ.get("PYTHONPATH", "")])
        self.log = folder / "log"
        self.server = subprocess.Popen(
            [sys.executable, str(root / "killed_runs.py")],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, arguments: list[str], number: int | None = None, delay: float = 0.0) -> dict[str, Any]:
        """Run to the end, or until a signal."""
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        request = {"arguments": arguments, "log": str(self.log), "signal": number, "delay": delay}
        self.server.stdin.write(json.dumps(request) + "\n")
        self.server.stdin.flush()
        answer = json.loads(self.server.stdout.readline())
        said = self.log.read_text() if self.log.exists() else ""
        assert "Traceback" not in said
        assert "***" not in said  # pycolmap's trace
        assert answer["left"] == []
        if number is None:
            assert answer["status"] == 0, said
        elif number == SIGTERM:  # it was too early, it was heard, or it was too late
            assert answer["status"] in (-SIGTERM, 128 + SIGTERM, 0), said
            assert (SAID in said.splitlines()) == (answer["status"] == 128 + SIGTERM)
        return answer


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runs]:
    runs = Runs(tmp_path_factory.mktemp("runs"))
    yield runs
    assert runs.server.stdin is not None
    runs.server.stdin.close()
    assert runs.server.wait() == 0
    if runs.server.stdout is not None:
        runs.server.stdout.close()


def moments(verb: str, seconds: float) -> Iterator[tuple[int, float]]:
    """Signals and when to send them, within the time that an undisturbed run takes."""
    rng = random.Random(f"{verb} {os.environ.get('MVSEG_KILL_SEED', '0')}")
    first = rng.randrange(2)
    for number in range(KILLS):
        yield (SIGKILL, SIGTERM)[(first + number) % 2], rng.uniform(0, seconds)


def read_result(folder: Path) -> dict[str, str]:
    """The files of a whole result with their hashes, of the report its text; run.json lists all: a part would show."""
    listed = json.loads((folder / "run.json").read_text())["files"]
    there = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    assert {name: hash_files(there[name]) for name in listed} == listed
    assert there.keys() - listed.keys() <= {"run.json", "notes.txt"}
    if "report.html" not in there:  # the tables of a batch
        return listed
    page = there["report.html"].read_text(encoding="utf-8")
    return listed | {"report.html": re.sub(r'"seconds": ?\{[^}]*\}', "", page)}  # timings differ from run to run


@pytest.fixture(scope="module")
def earlier(runs: Runs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of other options, which the runs replace."""
    folder = tmp_path_factory.mktemp("earlier")
    plant = write_scene(folder / "plant", 2)
    runs(["match", str(plant), "--out", str(folder / "out"), "--quiet"])
    return folder / "out" / "plant"


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["infer", "detect"])
def test_a_result_is_old_or_new(verb: str, runs: Runs, earlier: Path, tmp_path: Path) -> None:
    """ "detect" is `mvseg infer` without masks, whose detections are kept until it is done."""
    plant, out = write_scene(tmp_path / "plant", 3 if verb == "infer" else 2), tmp_path / "out"
    place = out / "plant"
    coarse = ["--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500", "--out", str(place), "--quiet"]
    coarse += ["--overwrite", "true"]  # the earlier result is of another folder
    run = {"infer": ["infer", str(plant), "--masks", "masks", *coarse], "detect": ["infer", str(plant), *coarse]}[verb]
    seconds = runs(run)["seconds"]
    old, new = read_result(earlier), read_result(place)
    assert old != new
    for number, (signal, delay) in enumerate(moments(verb, seconds)):
        shutil.rmtree(place)
        if number % 4 != 3:  # now and then there is no earlier result
            shutil.copytree(earlier, place)
            (place / "notes.txt").write_text("three leaves")
        has_earlier = place.exists()
        runs(run, signal, delay)
        sweep_abandoned(place)  # as whatever writes there does
        if has_earlier:
            assert (place / "notes.txt").read_text() == "three leaves"
        if has_earlier or place.exists():
            assert read_result(place) in (old, new)
        if signal == SIGTERM:
            assert {path.name for path in out.iterdir()} <= {"plant", "plant.detections"}
        runs(run)
        assert read_result(place) == new
        assert [path.name for path in out.iterdir()] == ["plant"]
        counts = json.loads((place / "run.json").read_text())["counts"]
        assert len(read_instances(place, plant / "truth")[0]) == counts["regions"]


@pytest.mark.slow
def test_a_batch_goes_on_where_it_was_killed(runs: Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each result is old or new, and in the end all tables are those of a batch that was never disturbed."""
    names, out, earlier = ("aloe", "basil", "mint"), tmp_path / "out", tmp_path / "earlier"
    plants = [write_scene(tmp_path / "plants" / name, 2 + number % 2) for number, name in enumerate(names)]
    run = ["batch", str(plants[0].parent), "--masks", "masks", "--out", str(out), "--quiet", "--num_workers", "2"]
    run += ["--resume", "true", "--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500"]
    monkeypatch.setattr("mvseg.batch.run_batch.run_locally", run_here)
    monkeypatch.chdir(tmp_path)  # where no masks/ lies
    assert main([*run, "--match.seed", "7", "--unit", "cm", "--scale", "0.1"]) == 0
    shutil.copytree(out, earlier)
    seconds = runs(run)["seconds"]
    old, new = ({name: read_result(of / name) for name in names} for of in (earlier, out))
    tables = {path.name: path.read_bytes() for path in (out / "tables").glob("traits*")}
    assert len(tables) == 2
    assert all(old[name] != new[name] for name in names)
    for number, (signal, delay) in enumerate(moments("batch", seconds)):
        shutil.rmtree(out)
        if number % 3:
            shutil.copytree(earlier, out)
        runs(run, signal, delay)
        for name in names:
            if number % 3 or (out / name).exists():
                assert read_result(out / name) in (old[name], new[name])
        if number % 3 or (out / "tables").exists():
            read_result(out / "tables")
        if signal == SIGTERM and out.exists():
            assert {path.name for path in out.iterdir()} <= {*names, "tables", "_batch"}
        runs(run)
        assert {path.name for path in out.iterdir()} == {*names, "tables", "_batch"}
        assert {name: read_result(out / name) for name in names} == new
        read_result(out / "tables")
        assert {name: (out / "tables" / name).read_bytes() for name in tables} == tables


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [2] if KILLS < 5 else [0, 2])
def test_a_resumed_training_run_ends_as_one_that_was_never_killed(num_workers: int, runs: Runs, tmp_path: Path) -> None:
    photos, labels = write_photos(tmp_path, 6)
    options = {"photos": photos, "labels": labels, "hold_out_every": 3, "image_size": 64, "epochs": 2, "batch_size": 2}
    options |= {"num_workers": num_workers, "device": "cpu", "checkpoint_every": 1, "log_every": 1, "ema_decay": 0.5}
    options["precision"] = "fp32"  # "auto" asks the clock

    def arguments(output: Path) -> list[str]:
        given = options | {"output": output, "resume": "true"}
        return ["train", *(f"--{name}={value}" for name, value in given.items())]

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    seconds = runs(arguments(whole))["seconds"]
    for signal, delay in moments(f"train {num_workers}", seconds):
        runs(arguments(killed), signal, delay)
        if (killed / "checkpoint.pt").exists():
            read_checkpoint(killed / "checkpoint.pt", "cpu")  # type: ignore[arg-type]
        if (killed / "model.safetensors").exists():
            assert read_weights(killed / "model.safetensors")[1] is not None
        if signal == SIGTERM and killed.exists():
            assert not list(killed.glob(".*"))
    runs(arguments(killed))
    assert not list(killed.glob(".*"))
    assert (killed / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


@pytest.mark.slow
def test_a_data_set_that_was_killed_ends_as_one_that_was_not(runs: Runs, tmp_path: Path) -> None:
    seconds = runs(["simulate", "tiny", "--out", str(tmp_path / "whole")])["seconds"]
    whole = read_tree(tmp_path / "whole")
    for signal, delay in moments("simulate", seconds):
        runs(["simulate", "tiny", "--out", str(tmp_path / "killed")], signal, delay)
        for scene in (tmp_path / "killed").glob("*/[!.]*"):
            assert read_tree(scene) == read_tree(tmp_path / "whole" / scene.relative_to(tmp_path / "killed"))
    runs(["simulate", "tiny", "--out", str(tmp_path / "killed")])
    assert read_tree(tmp_path / "killed") == whole


def read_tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
