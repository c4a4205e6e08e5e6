"""Growth: rates with their standard deviations, curves of known parameters, the plant as a whole."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mvseg.tracking.dates import Number, PlantOnDate
from mvseg.tracking.growth import measure_growth, slope
from mvseg.tracking.track import TrackRow, Tracks
from tests.plants_over_days import grow_blades, see


def one_leaf(areas: list[float], times: list[float], *, sd: float = 0.02) -> Tracks:
    """A track of these areas."""
    date, _ = see(grow_blades(1, 0), 0)

    def on(time: float, area: float) -> PlantOnDate:
        leaf = replace(date.leaves[0], numbers={"area": Number(area, sd * area, "mm^2")})
        return replace(date, time=time, written=f"{time:g}", leaves=(leaf,))

    dates = tuple(on(time, area) for time, area in zip(times, areas, strict=True))
    rows = tuple(TrackRow(date=index, track=1, state="seen", leaf=1) for index in range(len(times)))
    return Tracks("p", dates, rows, np.tile(np.eye(4), (len(times), 1, 1)), (0,) * len(times), ())


def test_slopes_and_their_deviations() -> None:
    rate, sd = slope(np.array([0.0, 2.0]), np.array([1.0, 5.0]), np.array([0.3, 0.4]))
    assert (rate, sd) == (pytest.approx(2.0), pytest.approx(0.25))  # sqrt(0.09 + 0.16) / 2
    assert math.isnan(slope(np.array([0.0]), np.array([1.0]), np.array([0.1]))[0])
    rate, sd = slope(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 2.0]), np.full(3, math.nan))
    assert rate == pytest.approx(1.0)
    assert math.isnan(sd)


def test_points_carry_the_numbers_of_the_results() -> None:
    points = measure_growth(one_leaf([100, 140, 180], [0, 2, 4])).points
    assert [point.number.value for point in points] == [100, 140, 180]
    assert [point.number.sd for point in points] == pytest.approx([2, 2.8, 3.6])
    assert [point.rate for point in points] == pytest.approx([20] * 3)


@pytest.mark.parametrize(
    ("model", "curve"),
    [
        ("logistic", lambda t: 900 / (1 + np.exp(-0.7 * (t - 6)))),
        ("expolinear", lambda t: 60 / 0.9 * np.log1p(np.exp(0.9 * (t - 3)))),
        ("constant", lambda t: np.full_like(t, 500.0)),
    ],
)
def test_curves_of_known_parameters(model: str, curve: Callable[[np.ndarray], np.ndarray]) -> None:
    times = np.arange(0, 13, 1.5)
    (found,) = measure_growth(one_leaf(curve(times).tolist(), times.tolist())).curves
    assert found.model == model
    np.testing.assert_allclose(found.at(times), curve(times), rtol=0.03, atol=3)
    if model == "logistic":
        assert found.parameters == pytest.approx((900, 0.7, 6), rel=0.02)
        assert 0 < found.sds[0] < 30


def test_one_wrong_date_does_not_bend_a_curve() -> None:
    times = np.arange(0, 13, 1.5)
    areas = 900 / (1 + np.exp(-0.7 * (times - 6)))
    areas[6] *= 0.5
    (found,) = measure_growth(one_leaf(areas.tolist(), times.tolist())).curves
    assert found.parameters[0] == pytest.approx(900, rel=0.06)


def test_few_dates_get_no_curve() -> None:
    assert measure_growth(one_leaf([1, 2, 3, 4], [0, 1, 2, 3])).curves == ()


def test_the_plant_grows() -> None:
    first, second = measure_growth(one_leaf([100, 100 * math.e], [0, 2])).plant
    assert math.isnan(first.relative_growth_rate.value)
    assert second.relative_growth_rate.value == pytest.approx(0.5)
    assert second.relative_growth_rate.sd == pytest.approx(math.hypot(0.02, 0.02) / 2)
    assert (second.leaves, second.born, second.gone) == (1, 0, 0)
    assert math.isnan(second.phyllochron)
