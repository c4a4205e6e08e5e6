"""Growth: rates with their standard deviations, and the plant as a whole."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mvseg.tracking.dates import Number, PlantOnDate
from mvseg.tracking.growth import measure_growth, slope
from mvseg.tracking.track import TrackRow, Tracks, track_leaves
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


@pytest.mark.parametrize("goes", [False, True])
def test_no_height_grows_because_the_lowest_leaf_is_lost(goes: bool) -> None:
    """Nothing grows, and the pot is turned: heights start from another leaf, which is no growth."""
    blades = grow_blades(8, 3)
    lowest = min(blades, key=lambda leaf: blades[leaf].reshape(-1, 3)[:, 2].min())

    def on(time: float, left: dict[int, np.ndarray]) -> PlantOnDate:
        date, _ = see(left, time, turn=40 * time)
        ground = min(blade.reshape(-1, 3)[:, 2].min() for blade in left.values())
        heights = [Number(float(np.asarray(leaf.midrib)[0, 2] - ground), 0.2, "mm") for leaf in date.leaves]
        leaves = [replace(leaf, numbers={**leaf.numbers, "insertion_height": height})
                  for leaf, height in zip(date.leaves, heights, strict=True)]  # fmt: skip
        return replace(date, leaves=tuple(leaves), up_from="scene")

    rest = {leaf: blade for leaf, blade in blades.items() if leaf != lowest or not goes}
    tracks = track_leaves([on(0, blades), on(2, blades), on(4, rest), on(6, rest)])
    points = [point for point in measure_growth(tracks).points if point.trait == "insertion_height"]
    assert len(points) == (30 if goes else 32)
    rates = [point.rate for point in points if not math.isnan(point.rate)]
    assert len(rates) >= 28
    assert np.abs(rates).max() < 0.05
    least = min(point.number.value for point in points)
    assert (least < -1e-6) == goes  # the leaf that went was below the one that heights start from


def test_the_plant_grows() -> None:
    first, second = measure_growth(one_leaf([100, 100 * math.e], [0, 2])).plant
    assert math.isnan(first.relative_growth_rate.value)
    assert second.relative_growth_rate.value == pytest.approx(0.5)
    assert second.relative_growth_rate.sd == pytest.approx(math.hypot(0.02, 0.02) / 2)
    assert (second.leaves, second.born, second.gone) == (1, 0, 0)
    assert math.isnan(second.phyllochron)
