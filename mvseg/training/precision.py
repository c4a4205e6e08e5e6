"""Whether a training run is faster in bfloat16: GPUs are asked, CPUs are timed. CPUs with AMX or AVX-512 instructions
for bfloat16 take about half the time of float32 for most layers; those without take up to twelve times as long."""

from __future__ import annotations

import copy
import logging
import time

import torch
from torch import Tensor, nn

from mvseg.training.augmentation import Target
from mvseg.training.config import TrainConfig

logger = logging.getLogger(__name__)

WORTHWHILE = 0.9  # chosen: of float32's time: bfloat16 must be faster than that to be worth its precision


def choose_bf16(config: TrainConfig, model: nn.Module, *, photos: list[Tensor], targets: list[Target]) -> bool:
    """Whether the forward pass of a run is to be under bfloat16 autocast, see `TrainConfig.precision`.

    The detector, in train mode on the run's device, and torch's generators stay as they are; photos and targets are of
    one forward pass, on the CPU.
    """
    device = next(model.parameters()).device
    if config.precision != "auto":
        return config.precision == "bf16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    with torch.random.fork_rng(devices=[]):
        fp32, bf16 = (time_passes(model, photos, targets, is_bf16=is_bf16) / len(photos) for is_bf16 in (False, True))
    chosen = bf16 < WORTHWHILE * fp32
    name = "bf16" if chosen else "fp32"
    logger.info("a sample takes %.2f s of CPU in fp32 and %.2f s in bf16: training in %s", fp32, bf16, name)
    return chosen


def time_passes(model: nn.Module, photos: list[Tensor], targets: list[Target], *, is_bf16: bool) -> float:
    """Seconds of CPU time for a forward and backward pass, the faster of two (the first one builds caches). On a shared
    machine, wall time would also measure other processes."""
    trial, seconds = copy.deepcopy(model), []
    for _ in range(2):
        torch.manual_seed(0)  # the same anchors and RoIs for both precisions
        started = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=is_bf16):
            losses = trial(list(photos), [dict(target) for target in targets])
        torch.stack([loss.float() for loss in losses.values()]).sum().backward()
        seconds.append(time.process_time() - started)
    return min(seconds)
