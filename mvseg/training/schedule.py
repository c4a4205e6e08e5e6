"""The learning rate of each step: linear warm-up, then cosine, multistep or constant.

A function of the step: unlike torch's schedulers it has no state that a checkpoint must hold.
"""

from __future__ import annotations

import math

from mvseg.training.config import TrainConfig


def learning_rate(config: TrainConfig, step: int, num_steps: int) -> float:
    """The rate of step 0 <= step < num_steps, see `TrainConfig.lr`, `schedule` and `warmup_steps`."""
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
