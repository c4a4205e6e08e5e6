"""The parts of a training run: configs, one step of the optimizer, files."""

from __future__ import annotations

import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from mvseg.detectors.mask_rcnn import list_architectures
from mvseg.detectors.zoo import load_detector
from mvseg.errors import InputError
from mvseg.training.config import TrainConfig
from mvseg.training.data import list_samples
from mvseg.training.loop import cut_log
from mvseg.training.state import TrainingState, apply_gradients, build_optimizer, learning_rate, start_state
from tiny_training import build_tiny, make_config, parse_config, write_photos

ROOT = Path(__file__).parents[2]
RECIPES = [*(ROOT / "configs" / "train").glob("*.yaml"), *(ROOT / "models").glob("*/recipe/leaf-*.yaml")]


@pytest.mark.parametrize("path", sorted(RECIPES), ids=lambda path: path.name)
def test_published_configs_are_sound(path: Path) -> None:
    config = parse_config(path)
    assert config.arch in list_architectures()
    assert not config.resume


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"epochs": 0}, "epochs is 0, expected at least 1"),
        ({"lr": math.nan}, "lr is nan"),
        ({"color_jitter": 1.5}, "color_jitter is 1.5, expected a number from 0 to 1"),
        ({"scale_range": (2.0, 1.0)}, "scale_range"),
        ({"batch_size": 3}, "batch_size 3 is not a multiple of images_per_forward 2"),
        ({"hold_out_every": 1}, "leaves nothing to train on"),
        ({"val_photos": Path()}, "belong together"),
        ({"val_photos": Path(), "val_labels": Path()}, "one way to validate"),
    ],
)
def test_config_problems(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_config(Path(), Path(), **changes)


def step_once(config: TrainConfig, gradient: float, averaged: bool = False) -> tuple[TrainingState, bool]:
    """A weight of 1 with this gradient after one step of rate 0.1, and what `apply_gradients` said."""
    models: list[Any] = [torch.nn.Linear(1, 1, bias=False) for _ in range(2)]
    for model in models:
        torch.nn.init.ones_(model.weight)
    state = TrainingState(models[0], build_optimizer(config, models[0]), models[1] if averaged else None)
    models[0].weight.grad = torch.full((1, 1), gradient)
    return state, apply_gradients(config, state, 0.1)


def test_gradients_are_clipped_and_followed_by_the_average() -> None:
    config = make_config(Path(), Path(), optimizer="sgd", weight_decay=0.0, clip_norm=2.0, ema_decay=0.99)
    state, applied = step_once(config, 50.0, averaged=True)
    assert applied
    assert state.step == 1
    assert state.model.weight.item() == pytest.approx(1 - 0.1 * 2.0)
    assert state.result.weight.item() == pytest.approx(0.1 * 1 + 0.9 * 0.8)  # the decay of the first step is 1 / 10
    unclipped, _ = step_once(dataclasses.replace(config, clip_norm=0.0), 5.0)
    assert unclipped.model.weight.item() == pytest.approx(0.5)


def test_running_statistics_are_followed_too() -> None:
    """Of a live BatchNorm: an average that kept 0 and 1 would be exported with them."""
    config = make_config(Path(), Path(), optimizer="sgd", ema_decay=0.99)
    model: Any = torch.nn.Sequential(torch.nn.Conv2d(1, 2, 1), torch.nn.BatchNorm2d(2))
    state = TrainingState(model.train(), build_optimizer(config, model), copy.deepcopy(model).eval())
    photo = torch.linspace(3, 9, 32).reshape(2, 1, 4, 4)
    expected = {"running_mean": torch.zeros(2), "running_var": torch.ones(2)}
    for step in range(4):
        model(photo).square().sum().backward()
        assert apply_gradients(config, state, 0.01)
        share = 1 - min(0.99, (1 + step) / (10 + step))
        for name, value in expected.items():
            value.lerp_(getattr(model[1], name), share)
    averaged: Any = state.result
    for name, value in expected.items():
        assert getattr(averaged[1], name).tolist() == pytest.approx(value.tolist(), rel=1e-5)
    assert averaged[1].num_batches_tracked == 4
    assert not torch.allclose(averaged[1].running_var, model[1].running_var, rtol=1e-3)  # not copied


def test_a_gradient_that_is_not_finite_changes_nothing() -> None:
    state, applied = step_once(make_config(Path(), Path()), math.nan)
    assert not applied
    assert state.step == 0
    assert state.model.weight.item() == 1


def test_biases_and_norms_are_not_decayed() -> None:
    groups = build_optimizer(make_config(Path(), Path(), weight_decay=0.3), build_tiny()).param_groups
    decay = {parameter.ndim > 1: group["weight_decay"] for group in groups for parameter in group["params"]}
    assert decay == {True: 0.3, False: 0.0}


def test_the_backbone_learns_at_its_own_rate(tmp_path: Path) -> None:
    photos, labels = write_photos(tmp_path / "data", 2)
    config = make_config(tmp_path / "data", tmp_path / "out", arch="efficientnet_lite0", backbone_lr=0.25)
    state = start_state(config, list_samples(photos, labels), device=torch.device("cpu"))
    for parameter in state.model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    assert apply_gradients(config, state, 0.1)
    name_of = {parameter: name for name, parameter in state.model.named_parameters()}
    rates = {name_of[parameter]: group["lr"] for group in state.optimizer.param_groups for parameter in group["params"]}
    assert {rate for name, rate in rates.items() if name.startswith("backbone.body.")} == {0.025}
    assert {rate for name, rate in rates.items() if not name.startswith("backbone.body.")} == {0.1}
    assert len(rates) == len(name_of)


def test_a_new_backbone_under_heads_that_have_learned(tmp_path: Path) -> None:
    photos, labels = write_photos(tmp_path / "data", 2)
    config = make_config(tmp_path / "data", tmp_path / "out", arch="efficientnet_lite0", heads="leaf-lite")
    state = start_state(config, list_samples(photos, labels), device=torch.device("cpu")).model.state_dict()
    shipped = load_detector("leaf-lite").state_dict()
    taken = {name for name, value in shipped.items() if name in state and torch.equal(state[name], value)}
    assert taken == {name for name in shipped if not name.startswith("backbone.")}
    other = dataclasses.replace(config, arch="maskrcnn_resnet50_fpn")
    with pytest.raises(InputError, match=r"the heads of .*leaf-lite.* do not fit: "):
        start_state(other, list_samples(photos, labels), device=torch.device("cpu"))


def test_bfloat16_does_not_collapse_narrow_boxes_far_from_the_origin(tmp_path: Path) -> None:
    photos, labels = write_photos(tmp_path / "data", 2)
    config = make_config(tmp_path / "data", tmp_path / "out", image_size=320)
    model = build_tiny().float()
    target = {
        "boxes": torch.tensor([[303.0, 100.0, 304.0, 140.0]]),
        "labels": torch.ones(1, dtype=torch.int64),
        "masks": torch.zeros(1, 320, 320, dtype=torch.uint8),
    }
    target["masks"][0, 100:140, 303] = 1
    model.transform.min_size, model.transform.max_size = (320,), 320
    plain = copy.deepcopy(model).train()
    hooked = start_state(config, list_samples(photos, labels), device=torch.device("cpu"), model=model).model
    with torch.autocast("cpu", torch.bfloat16):
        broken, sound = (network([torch.zeros(3, 320, 320)], [target]) for network in (plain, hooked))
    assert not torch.isfinite(broken["loss_box_reg"])  # what torchvision alone makes of it
    assert all(torch.isfinite(loss) for loss in sound.values())


def test_learning_rate_warms_up_and_falls() -> None:
    config = make_config(Path(), Path(), lr=1.0, batch_size=16, warmup_steps=4)
    rates = [learning_rate(config, step, 100) for step in range(100)]
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert rates[4:] == sorted(rates[4:], reverse=True)
    assert rates[52] == pytest.approx(0.505)
    assert 0.01 < rates[-1] < 0.011
    drops = [learning_rate(dataclasses.replace(config, schedule="multistep"), step, 100) for step in (10, 59, 60, 85)]
    assert drops == pytest.approx([1.0, 1.0, 0.1, 0.01])
    assert learning_rate(config, 0, 10) == 0.5  # ten steps: one of warm-up


@pytest.mark.parametrize(("optimizer", "factor"), [("sgd", 0.25), ("adamw", 0.5)])
def test_learning_rate_scales_with_the_global_batch(optimizer: Any, factor: float) -> None:
    config = make_config(Path(), Path(), lr=1.0, batch_size=4, warmup_steps=0, optimizer=optimizer)
    assert learning_rate(config, 0, 100) == pytest.approx(factor)


def test_a_log_is_cut_where_the_run_goes_on(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"step": 4, "lo')
    cut_log(log, 2)
    assert log.read_text() == '{"step": 1}\n{"step": 2}\n'
    cut_log(tmp_path / "none.jsonl", 2)
