"""Learning rates."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from mvseg.training.schedule import learning_rate
from tiny_training import make_config


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
