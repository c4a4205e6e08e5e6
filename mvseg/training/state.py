"""The state of a training run: its start, its checkpoints, and its change by a step."""

from __future__ import annotations

import copy
import itertools
import logging
import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchvision.models.detection import MaskRCNN

from mvseg.detectors.mask_rcnn import build_detector
from mvseg.detectors.run import leave_autocast
from mvseg.detectors.weights_file import load_weights, read_weights
from mvseg.detectors.zoo import find_weights, weights_path
from mvseg.errors import InputError
from mvseg.system.atomic import write_whole
from mvseg.training.config import TrainConfig, config_difference, config_values
from mvseg.training.data import SampleList

logger = logging.getLogger(__name__)


@dataclass
class TrainingState:
    """All that changes during a run, and is in its checkpoints.

    Attributes:
        model: the detector itself, in train mode.
        averaged: exponential moving average of the model, buffers included, in eval mode; or None.
        step: steps done since the start of the run.
        history: one record per epoch that was trained and evaluated.
        loss_sums: sums of the losses over the steps of the unfinished epoch.
        is_bf16: whether the forward pass runs under bfloat16 autocast.
    """

    model: MaskRCNN
    optimizer: torch.optim.Optimizer
    averaged: MaskRCNN | None
    step: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)
    loss_sums: dict[str, float] = field(default_factory=dict)
    is_bf16: bool = False

    @property
    def result(self) -> MaskRCNN:
        """The model to evaluate and export."""
        return self.model if self.averaged is None else self.averaged


def start_state(
    config: TrainConfig, samples: SampleList, *, device: torch.device, model: MaskRCNN | None = None
) -> TrainingState:
    """The state that a run begins with, or resumes from if `config.resume` is set and there is a checkpoint.

    `model` is trained in place of `build_detector(config.arch, ...)`. Raises InputError: a checkpoint without `resume`,
    a damaged one, or one of another config or of other samples; see `build_detector`.
    """
    checkpoint = config.output / "checkpoint.pt"
    if checkpoint.is_file() and not config.resume:
        what = "holds the checkpoint of an earlier run"
        raise InputError(f"{config.output} {what}, expected --resume true or another output")
    torch.manual_seed(config.seed)
    if model is None:
        weights = config.weights and str(find_weights(config.weights) or config.weights)
        model = build_detector(config.arch, len(samples.categories) + 1, weights)
        if config.heads:
            take_heads(model, weights_path(config.heads))
    model.transform.min_size, model.transform.max_size = (config.image_size,), config.image_size
    model.rpn.head.register_forward_hook(leave_autocast)
    model = model.to(device=device, memory_format=torch.channels_last).train()  # a third faster on CPUs
    averaged = copy.deepcopy(model).eval() if config.ema_decay else None
    has_bf16 = device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    is_bf16 = has_bf16 if config.precision == "auto" else config.precision == "bf16"
    state = TrainingState(model, build_optimizer(config, model), averaged, is_bf16=is_bf16)
    if checkpoint.is_file():
        restore_state(state, read_checkpoint(checkpoint, device), config, samples)
        logger.info("resuming from step %d of %s", state.step, checkpoint)
    elif config.resume:
        logger.info("%s has no checkpoint yet: starting from the beginning", config.output)
    return state


def take_heads(model: MaskRCNN, path: Path) -> None:
    """Load everything but the backbone from another detector's weights. Raises InputError: no such weights, or heads of
    other shapes."""
    state, _ = read_weights(path)
    heads = {name: value.float() for name, value in state.items() if not name.startswith("backbone.")}
    body = {name: value for name, value in model.state_dict().items() if name.startswith("backbone.")}
    try:
        load_weights(model, body | heads)
    except InputError as error:
        raise InputError(f"the heads of {path} do not fit: {error}") from error


def read_checkpoint(path: Path, device: torch.device) -> dict[str, Any]:
    """The content of a checkpoint; nothing in the file is executed. Raises InputError: it is no checkpoint."""
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        content["model"], content["optimizer"], content["step"], content["config"]
    except Exception as error:  # torch.load has no common exception for a damaged file
        raise InputError(f"{path} is not a checkpoint of a training run ({type(error).__name__})") from error
    return content


def restore_state(state: TrainingState, saved: dict[str, Any], config: TrainConfig, samples: SampleList) -> None:
    """Put a checkpoint's content into a fresh state. Raises InputError: it has another config, or other samples."""
    if difference := config_difference(saved["config"], config_values(config)):
        raise InputError(f"the checkpoint in {config.output} was made with another {difference}, expected the same")
    if saved["samples"] != [sample.name for sample in samples.samples]:
        raise InputError(f"the checkpoint in {config.output} was made with other training samples, expected the same")
    state.model.load_state_dict(saved["model"])
    state.optimizer.load_state_dict(saved["optimizer"])
    if state.averaged is not None:
        state.averaged.load_state_dict(saved["ema"])
    state.step, state.history, state.loss_sums = saved["step"], saved["history"], saved["loss_sums"]
    state.is_bf16 = saved["is_bf16"]  # a run keeps its precision, also on another machine


def save_state(state: TrainingState, config: TrainConfig, samples: SampleList) -> None:
    """Write the checkpoint into `config.output`, whole. `build_detector` can read it as weights, too."""
    content = {
        "model": state.model.state_dict(),
        "ema": None if state.averaged is None else state.averaged.state_dict(),
        "optimizer": state.optimizer.state_dict(),
        "step": state.step,
        "history": state.history,
        "loss_sums": state.loss_sums,
        "is_bf16": state.is_bf16,
        "config": config_values(config),
        "samples": [sample.name for sample in samples.samples],
    }
    write_whole(config.output / "checkpoint.pt", lambda partial: torch.save(content, partial))


def build_optimizer(config: TrainConfig, model: nn.Module) -> torch.optim.Optimizer:
    """AdamW, or SGD with momentum 0.9; biases and norms are not decayed, frozen parameters are left out. Each group of
    parameters has a "factor" of the learning rate beside torch's own options."""
    members: dict[tuple[float, bool], list[nn.Parameter]] = defaultdict(list)
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            factor = config.backbone_lr if name.startswith("backbone.body.") else 1.0
            members[factor, parameter.ndim < 2].append(parameter)
    decay, groups = {False: config.weight_decay, True: 0.0}, []
    for factor, is_spared in sorted(members):
        group = members[factor, is_spared]
        groups.append({"params": group, "weight_decay": decay[is_spared], "factor": factor})
    if config.optimizer == "adamw":
        return torch.optim.AdamW(groups, lr=config.lr, fused=True)
    return torch.optim.SGD(groups, lr=config.lr, momentum=0.9)


def learning_rate(config: TrainConfig, step: int, num_steps: int) -> float:
    """The rate of step 0 <= step < num_steps, see `TrainConfig.lr`, `schedule` and `warmup_steps`. Unlike torch's
    schedulers it has no state that a checkpoint must hold."""
    scale = config.batch_size / 16
    peak = config.lr * (scale if config.optimizer == "sgd" else math.sqrt(scale))
    warmup = min(config.warmup_steps, num_steps // 10)
    if step < warmup:
        return peak * (step + 1) / (warmup + 1)
    if config.schedule == "constant":
        return peak
    if config.schedule == "multistep":
        return peak * 0.1 ** sum(step >= share * num_steps for share in (0.6, 0.85))
    progress = (step - warmup) / (num_steps - warmup)
    return peak * (0.01 + 0.99 * (1 + math.cos(math.pi * progress)) / 2)


@torch.no_grad()
def apply_gradients(config: TrainConfig, state: TrainingState, rate: float) -> bool:
    """Clip the gradients, step the optimizer, follow with the average, count the step. Returns False, and changes
    nothing, when a gradient is not finite."""
    parameters = [parameter for group in state.optimizer.param_groups for parameter in group["params"]]
    norm = nn.utils.clip_grad_norm_(parameters, config.clip_norm or math.inf)
    if not bool(torch.isfinite(norm)):
        return False
    for group in state.optimizer.param_groups:
        group["lr"] = rate * group["factor"]
    state.optimizer.step()
    if state.averaged is not None:  # torch's AveragedModel would copy the first weights, and rename them
        decay = min(config.ema_decay, (1 + state.step) / (10 + state.step))
        # Running statistics of a live BatchNorm belong to the weights that they were measured with: averaged, too.
        models = (state.averaged, state.model)
        here, there = (itertools.chain(each.parameters(), each.buffers()) for each in models)
        for average, current in zip(here, there, strict=True):
            if average.is_floating_point():
                average.lerp_(current, 1 - decay)
            else:  # numbers of tracked batches
                average.copy_(current)
    state.step += 1
    return True
