"""Training runs: what they write, that nothing changes with processes, workers or kills, and how they fail."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml  # type: ignore[import-untyped]

import mvseg.training.loop
from mvseg.detectors.mask_rcnn import build_detector
from mvseg.errors import InputError
from mvseg.system.atomic import is_partial
from mvseg.training.loop import Run, TrainConfig, find_samples, load_chunks, train
from mvseg.training.processes import Processes, join_processes
from tiny_training import build_tiny, load_weights, make_config, parse_config, write_photos

TESTS = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def leaves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 photos: 24 to train on, 6 to validate."""
    folder = tmp_path_factory.mktemp("leaves")
    write_photos(folder, 30)
    return folder


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """8 photos, for runs of which only the files matter."""
    folder = tmp_path_factory.mktemp("few")
    write_photos(folder, 8)
    return folder


@pytest.fixture(scope="module")
def finished(leaves: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a run that nothing disturbed."""
    output = tmp_path_factory.mktemp("finished")
    train(make_config(leaves, output), build_tiny())
    return output


def read_log(output: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]


def read_metrics(output: Path) -> dict[str, Any]:
    """metrics.json without the times."""
    metrics = json.loads((output / "metrics.json").read_text())
    for record in (*metrics["epochs"], metrics["best"]):
        del record["seconds"]
    return metrics


def run_script(log: Path, *arguments: str | Path) -> None:
    """Run tiny_training.py; what it prints goes to a file."""
    paths = [str(TESTS.parent), str(TESTS), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, TESTS / "tiny_training.py", *arguments]
    with log.open("w") as file:
        result = subprocess.run(command, env=environment, stdout=file, stderr=file, timeout=120, check=False)
    assert result.returncode == 0, log.read_text()


def test_a_run_learns_and_writes_its_files(finished: Path, leaves: Path) -> None:
    metrics, log = read_metrics(finished), read_log(finished)
    assert [record["step"] for record in log] == list(range(1, 13))
    assert metrics["epochs"][1]["loss"] < metrics["epochs"][0]["loss"]
    assert metrics["finished"]
    assert (metrics["num_training_samples"], metrics["num_validation_samples"]) == (24, 6)
    first = metrics["epochs"][0]
    assert first["loss"] == pytest.approx(np.mean([record["loss"] for record in log[:6]]))
    assert first["loss"] == pytest.approx(sum(value for name, value in first.items() if name.startswith("loss_")))
    assert 0 < metrics["best"]["mask_AP"] == max(record["mask_AP"] for record in metrics["epochs"])
    config = yaml.safe_load((finished / "config.yaml").read_text())
    assert config["photos"] == str(leaves / "photos")
    assert config["scale_range"] == [0.6, 1.6]
    assert list(config) == [field.name for field in dataclasses.fields(TrainConfig)]


def test_the_export_is_the_average_of_the_best_epoch(leaves: Path, finished: Path) -> None:
    checkpoint = torch.load(finished / "checkpoint.pt", weights_only=True)
    exported = load_weights(finished / "model.safetensors")
    is_last_best = read_metrics(finished)["best_epoch"] == 1
    same = all(torch.equal(exported[key], value) for key, value in checkpoint["ema"].items())
    assert same == is_last_best
    assert any(not torch.equal(exported[key], value) for key, value in checkpoint["model"].items())


def test_without_validation_the_last_epoch_is_exported(few: Path, tmp_path: Path) -> None:
    before = torch.get_rng_state()
    train(make_config(few, tmp_path, hold_out_every=0, ema_decay=0.0, optimizer="sgd"), build_tiny())
    assert torch.equal(torch.get_rng_state(), before)
    checkpoint = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    exported = load_weights(tmp_path / "model.safetensors")
    assert all(torch.equal(exported[key], value) for key, value in checkpoint["model"].items())
    assert "mask_AP" not in read_metrics(tmp_path)["best"]


def test_bf16_on_the_cpu_is_close_to_fp32(leaves: Path, tmp_path: Path, finished: Path) -> None:
    train(make_config(leaves, tmp_path, precision="bf16", epochs=1), build_tiny())
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["is_bf16"] is True
    ours, exact = read_log(tmp_path)[0]["loss"], read_log(finished)[0]["loss"]
    assert ours != exact
    assert ours == pytest.approx(exact, rel=0.05)


def test_a_shipped_architecture_trains_and_its_export_loads(tmp_path: Path) -> None:
    write_photos(tmp_path, 4)
    config = make_config(tmp_path, tmp_path / "out", arch="mobilenet_v3_large_fpn", epochs=1, hold_out_every=0)
    train(dataclasses.replace(config, ema_decay=0.0))
    weights = str(tmp_path / "out" / "model.safetensors")
    loaded = build_detector("mobilenet_v3_large_fpn", 2, weights)
    assert loaded.transform.max_size == 64
    expected = torch.load(tmp_path / "out" / "checkpoint.pt", weights_only=True)["model"]
    assert all(torch.equal(value, expected[key]) for key, value in loaded.state_dict().items())


@pytest.mark.slow
def test_two_processes_do_what_one_does(leaves: Path, tmp_path: Path, finished: Path) -> None:
    """The same losses in every step, the same weights and AP; one process does two forward passes where two do one."""
    out = tmp_path / "out"
    run_script(tmp_path / "log", leaves, out)
    for ours, theirs in zip(read_log(out), read_log(finished), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-5)
    for key, value in load_weights(finished / "model.safetensors").items():
        torch.testing.assert_close(load_weights(out / "model.safetensors")[key], value, rtol=1e-4, atol=1e-6)
    for ours, theirs in zip(read_metrics(out)["epochs"], read_metrics(finished)["epochs"], strict=True):
        assert ours == pytest.approx(theirs, rel=1e-4)


def test_resuming_a_finished_run_changes_nothing(few: Path, tmp_path: Path) -> None:
    config = make_config(few, tmp_path, epochs=1)
    train(config, build_tiny())
    before = (tmp_path / "checkpoint.pt").read_bytes()
    train(dataclasses.replace(config, resume=True), build_tiny())
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_what_is_not_finite_names_its_photos(leaves: Path, tmp_path: Path) -> None:
    config = make_config(leaves, tmp_path, optimizer="sgd", lr=1e30, clip_norm=0.0, warmup_steps=0)
    with pytest.raises(InputError, match=r"(loss|gradient) of step \d+ .* is not finite on leaf_\d+\.png, leaf_"):
        train(config, build_tiny())
    model = build_tiny()
    model.backbone[0].weight.register_hook(lambda gradient: gradient * math.inf)
    with pytest.raises(InputError, match=r"gradient of step 0 \(epoch 1\) is not finite on (leaf_\d+\.png(, )?){4}:"):
        train(make_config(leaves, tmp_path), model)


def test_broken_samples_stop_the_start_or_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    photos, labels = write_photos(tmp_path, 8)
    (photos / "leaf_3.png").write_bytes(b"no image")
    (labels / "leaf_6.png").unlink()
    config = make_config(tmp_path, tmp_path / "out", hold_out_every=4, epochs=1)
    with pytest.raises(InputError, match=r"2 of 6 training samples are broken \(leaf_3.png: .*; leaf_6.png: "):
        train(config, build_tiny())
    assert not (tmp_path / "out").exists()
    with caplog.at_level(logging.INFO):
        train(dataclasses.replace(config, skip_broken=True), build_tiny())
    assert "4 samples to train on, 2 to validate, 2 skipped" in caplog.text
    assert len((tmp_path / "out" / "broken_samples.txt").read_text().splitlines()) == 2


def test_another_run_is_not_overwritten(leaves: Path, finished: Path) -> None:
    with pytest.raises(InputError, match="holds the checkpoint of an earlier run, expected --resume true"):
        train(make_config(leaves, finished), build_tiny())
    with pytest.raises(InputError, match=r"made with another lr \(0.02, now 0.5\)"):
        train(make_config(leaves, finished, resume=True, lr=0.5), build_tiny())


def test_a_finished_run_can_be_prolonged(few: Path, tmp_path: Path) -> None:
    """And then it is the run that had the longer end from the start, where the learning rate is constant."""
    config = {"schedule": "constant", "hold_out_every": 0}
    train(make_config(few, tmp_path / "once", epochs=2, **config), build_tiny())
    train(make_config(few, tmp_path / "twice", epochs=1, **config), build_tiny())
    train(make_config(few, tmp_path / "twice", epochs=2, resume=True, **config), build_tiny())
    assert len(read_metrics(tmp_path / "twice")["epochs"]) == 2
    once, twice = (load_weights(tmp_path / name / "model.safetensors") for name in ("once", "twice"))
    for key, value in once.items():
        torch.testing.assert_close(twice[key], value, rtol=0, atol=0)
    with pytest.raises(InputError, match=r"made with another epochs \(2, now 1\)"):
        train(make_config(few, tmp_path / "twice", epochs=1, resume=True, **config), build_tiny())


def test_a_folder_of_other_things_is_left_alone_and_a_failed_start_leaves_none(leaves: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("precious")
    with pytest.raises(InputError, match="holds files that are not a run of mvseg train"):
        train(make_config(leaves, tmp_path / "mine"), build_tiny())
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    with pytest.raises(InputError, match="leaf-litee"):
        train(make_config(leaves, tmp_path / "out", weights="leaf-litee"))
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
def test_a_signal_to_all_processes_is_left_to_the_run(leaves: Path, tmp_path: Path) -> None:
    """Schedulers send SIGTERM to the workers, too, whose death would end the run with a traceback."""
    config = make_config(leaves, tmp_path, num_workers=1)
    with join_processes("cpu") as processes:
        run = Run(config=config, processes=processes, samples=find_samples(config)[0], held_out=None)
        chunks: Any = load_chunks(run, 0)
        for number in range(6):  # more than are loaded ahead
            next(chunks)
            if number == 0:
                os.kill(chunks._workers[0].pid, signal.SIGTERM)


def test_what_a_killed_run_left_half_written_is_deleted(few: Path, tmp_path: Path) -> None:
    """Also by a run that was killed while it wrote its first file."""
    (tmp_path / ".config.yaml.77.partial").write_text("")
    train(make_config(few, tmp_path, resume=True, epochs=1), build_tiny())
    assert (tmp_path / "model.safetensors").is_file()
    assert not any(is_partial(path) for path in tmp_path.iterdir())


def test_a_run_does_not_go_on_with_other_samples(tmp_path: Path) -> None:
    write_photos(tmp_path, 5)
    config = make_config(tmp_path, tmp_path / "out", epochs=1, hold_out_every=0)
    train(config, build_tiny())
    for folder in ("photos", "labels"):
        (tmp_path / folder / "leaf_4.png").rename(tmp_path / folder / "leaf_9.png")
    with pytest.raises(InputError, match="made with other training samples"):
        train(dataclasses.replace(config, resume=True), build_tiny())
    (tmp_path / "out" / "checkpoint.pt").write_bytes(b"torn")
    with pytest.raises(InputError, match="is not a checkpoint of a training run"):
        train(dataclasses.replace(config, resume=True), build_tiny())


def test_processes_must_share_the_chunks_evenly(leaves: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def three(device: str) -> Iterator[Processes]:
        yield Processes(0, 3, torch.device(device))

    monkeypatch.setattr(mvseg.training.loop, "join_processes", three)
    with pytest.raises(InputError, match=r"is 2, expected a multiple of the number of processes \(3\)"):
        train(make_config(leaves, tmp_path), build_tiny())


def test_a_device_that_is_not_there(leaves: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="device 'tpu'"):
        train(make_config(leaves, tmp_path, device="tpu"), build_tiny())


def test_the_written_config_starts_the_same_run(finished: Path, leaves: Path) -> None:
    assert parse_config(finished / "config.yaml") == make_config(leaves, finished)


def test_validation_set_of_other_categories(leaves: Path, tmp_path: Path) -> None:
    image = {"id": 0, "file_name": "leaf_1.png", "width": 64, "height": 64}
    coco = {"images": [image], "annotations": [], "categories": [{"id": 1, "name": "fruit"}]}
    (tmp_path / "val.json").write_text(json.dumps(coco))
    config = make_config(
        leaves, tmp_path / "out", hold_out_every=0, val_photos=leaves / "photos", val_labels=tmp_path / "val.json"
    )
    with pytest.raises(InputError, match="has categories"):
        train(config, build_tiny())


@pytest.mark.slow
@pytest.mark.shared_data
def test_a_few_steps_on_real_rosettes(shared_data: Path, tmp_path: Path) -> None:
    shared = shared_data / "rosettes-cvppp-a1"
    config = make_config(Path(), tmp_path, hold_out_every=10, batch_size=6, epochs=1, image_size=128, ema_decay=0.0)
    train(dataclasses.replace(config, photos=shared / "images", labels=shared / "labels"), build_tiny())
    metrics, losses = read_metrics(tmp_path), [record["loss"] for record in read_log(tmp_path)]
    assert (metrics["num_training_samples"], metrics["num_validation_samples"]) == (90, 10)
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 0.05
    assert metrics["best"]["mask_AP"] is not None
