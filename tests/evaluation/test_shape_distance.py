"""d(I, T) between point sets."""

from __future__ import annotations

import math

import pytest
import torch

from mvseg.evaluation.shape_distance import shape_distance


def test_shape_distance_agrees_with_a_loop_and_scales() -> None:
    generator = torch.Generator().manual_seed(0)
    first, second = torch.randn(30, 3, generator=generator), torch.randn(20, 3, generator=generator)
    apart = torch.cdist(first, second)
    expected = float((apart.min(1)[0].mean() + apart.min(0)[0].mean()) / 2)
    assert shape_distance(first, second) == pytest.approx(expected, rel=1e-5)
    assert shape_distance(second, first) == pytest.approx(expected, rel=1e-5)
    assert shape_distance(10 * first, 10 * second) == pytest.approx(10 * expected, rel=1e-5)
    assert shape_distance(first, first) == 0
    assert math.isnan(shape_distance(first, torch.zeros(0, 3)))
