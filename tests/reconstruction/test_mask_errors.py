from __future__ import annotations

import numpy as np
import pytest

from mvseg.reconstruction.numbers import ERRORS
from mvseg.reconstruction.surface.mask_errors import learn_mask_errors, winsorised_mean

RNG = np.random.default_rng(5)
FLAT = [RNG.choice([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0], 10) + RNG.normal(0, 0.1, 10) for _ in range(30)]
NORMAL = [RNG.normal(0, 2, 10) for _ in range(30)]


def deviation(offsets: list[np.ndarray]) -> tuple[float, float]:
    """Of the centres that the errors give, and of the winsorised means; the true centre is 0."""
    errors = learn_mask_errors(offsets)
    assert errors is not None
    return float(np.std([errors.centre(each)[0] for each in offsets])), float(np.std([*map(winsorised_mean, offsets)]))


def test_errors_that_end_sharply_are_centred_by_their_extremes() -> None:
    learned, plain = deviation(FLAT)
    assert learned < 0.5 * plain
    learned, plain = deviation(NORMAL)
    assert learned < 1.2 * plain


@pytest.mark.parametrize("offsets", [FLAT, NORMAL])
def test_centre_lies_within_its_deviations(offsets: list[np.ndarray]) -> None:
    errors = learn_mask_errors(offsets)
    assert errors is not None
    inside = [abs(centre) < 2 * deviation for centre, deviation in map(errors.centre, offsets)]
    assert np.mean(inside) > 0.75


def test_clean_masks_and_few_masks_teach_nothing() -> None:
    assert learn_mask_errors([0.02 * each for each in NORMAL]) is None
    assert learn_mask_errors([np.arange(ERRORS.least_masks - 1.0)]) is None
    assert learn_mask_errors([]) is None
    assert winsorised_mean(np.array([0.0, 1, 2, 3, 100])) == pytest.approx(2)
    assert winsorised_mean(np.array([4.0])) == 4
