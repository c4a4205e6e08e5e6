"""Which precision a run takes: measured where it is not said, kept when the run is resumed."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import pytest
import torch

import mvseg.training.loop
import mvseg.training.precision
from mvseg.training.loop import train
from mvseg.training.precision import choose_bf16, time_passes
from tiny_training import build_tiny, make_config, write_photos


def one_pass() -> dict[str, Any]:
    box = torch.tensor([[10.0, 10.0, 40.0, 50.0]])
    target = {"boxes": box, "labels": torch.tensor([1]), "masks": torch.ones((1, 64, 64), dtype=torch.uint8)}
    return {"photos": [torch.rand(3, 64, 64)], "targets": [target]}


def set_times(monkeypatch: pytest.MonkeyPatch, *, fp32: float, bf16: float) -> None:
    def answer(*args: Any, is_bf16: bool) -> float:
        return bf16 if is_bf16 else fp32

    monkeypatch.setattr(mvseg.training.precision, "time_passes", answer)


@pytest.mark.parametrize(("fp32", "bf16", "chosen"), [(1.0, 0.5, True), (1.0, 12.35, False), (1.0, 0.95, False)])
def test_auto_takes_what_is_clearly_faster(
    fp32: float, bf16: float, chosen: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    set_times(monkeypatch, fp32=fp32, bf16=bf16)
    config = make_config(Path(), Path(), precision="auto")
    with caplog.at_level(logging.INFO):
        assert choose_bf16(config, build_tiny(), **one_pass()) == chosen
    assert f"{fp32:.2f} s of CPU in fp32 and {bf16:.2f} s in bf16" in caplog.text
    assert f"training in {'bf16' if chosen else 'fp32'}" in caplog.text


@pytest.mark.parametrize(("precision", "chosen"), [("bf16", True), ("fp32", False)])
def test_a_precision_that_is_said_is_not_measured(
    precision: str, chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(mvseg.training.precision, "time_passes")
    assert choose_bf16(make_config(Path(), Path(), precision=precision), build_tiny(), **one_pass()) == chosen


def test_measuring_changes_nothing() -> None:
    model, given = build_tiny().train(), one_pass()
    photos, targets = given["photos"], given["targets"]
    before, photo = {name: value.clone() for name, value in model.state_dict().items()}, photos[0].clone()
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    choose_bf16(make_config(Path(), Path(), precision="auto"), model, **given)
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    assert torch.equal(photos[0], photo)
    assert list(targets[0]) == ["boxes", "labels", "masks"]


def test_each_precision_is_timed_as_it_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, model = [], build_tiny().train()
    model.backbone.register_forward_hook(lambda module, inputs, output: seen.append(output.dtype))
    assert all(time_passes(model, **one_pass(), is_bf16=is_bf16) > 0 for is_bf16 in (False, True))
    assert seen == [torch.float32, torch.float32, torch.bfloat16, torch.bfloat16]


def test_a_resumed_run_keeps_its_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photos(tmp_path, 5)
    config = make_config(tmp_path, tmp_path / "out", precision="auto", epochs=1, hold_out_every=0)
    set_times(monkeypatch, fp32=1.0, bf16=0.1)
    train(config, build_tiny())
    assert torch.load(tmp_path / "out" / "checkpoint.pt", weights_only=True)["is_bf16"] is True
    monkeypatch.delattr(mvseg.training.loop, "choose_bf16")
    train(dataclasses.replace(config, resume=True), build_tiny())
