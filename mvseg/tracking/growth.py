"""Growth: curves and rates of each leaf, and what the plant as a whole does from date to date.

Standard deviations are those of the surfaces, carried through; errors of different dates count as independent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import least_squares
from scipy.special import expit

from mvseg.tracking.dates import Floats, Number
from mvseg.tracking.numbers import GROWTH
from mvseg.tracking.track import Tracks

TRAITS = (
    "area", "length", "width", "inclination", "curvature", "insertion_height", "node_height", "internode",
    "greenness_index",
)  # fmt: skip
SIZES = ("area", "length", "width")  # get a curve, too
NOTHING = Number(math.nan, math.nan, "")


@dataclass(frozen=True)
class GrowthPoint:
    """One trait of one leaf on one date; `rate` per day is the slope through this date and its neighbours; of two
    dates the later one has it."""

    track: int
    trait: str
    date: int
    number: Number
    rate: float
    rate_sd: float


@dataclass(frozen=True)
class GrowthCurve:
    """A smooth curve through the sizes of one leaf.

    Attributes:
        track, trait: whose.
        model: "constant" (full-grown, K), "logistic", K / (1 + exp(-r (t - t0))), or "expolinear",
            (c / r) ln(1 + exp(r (t - t0))).
        parameters: K, or the rate c of the linear growth; r, per day; and t0, days. The latter are NaN of a constant.
        sds: standard deviations of these three; NaN where the dates do not tell them.
        residual: root mean square of residuals, in standard deviations of the sizes.
        criterion: Akaike's.
    """

    track: int
    trait: str
    model: str
    parameters: tuple[float, ...]
    sds: tuple[float, ...]
    residual: float
    criterion: float

    def at(self, times: Floats) -> Floats:
        """The sizes at times (T,)."""
        return CURVES[self.model](self.parameters, times)


@dataclass(frozen=True)
class PlantRow:
    """The plant on one date; NaN where there is no number.

    Attributes:
        date: index into `Tracks.dates`.
        leaves, born, gone: numbers of leaves, and of leaves that appeared or went since the date before.
        phyllochron: days per leaf that appeared, since the first date.
        total_area: with its standard deviation.
        relative_growth_rate: of the area of those leaves that are measured on this date and the one before, per day,
            with its standard deviation.
    """

    date: int
    leaves: int
    born: int
    gone: int
    phyllochron: float
    total_area: Number
    relative_growth_rate: Number


@dataclass(frozen=True)
class Growth:
    """Growth of all leaves and of the plant.

    Attributes:
        points: all traits of all tracks on the dates on which they were measured, by track, trait and time.
        curves: of each size with `GROWTH.least_dates` dates or more, by track and trait.
        plant: one row per date.
    """

    points: tuple[GrowthPoint, ...]
    curves: tuple[GrowthCurve, ...]
    plant: tuple[PlantRow, ...]


def measure_growth(tracks: Tracks) -> Growth:
    """The growth of all leaves, and of the plant."""
    numbers = [{leaf.leaf: leaf.numbers for leaf in date.leaves} for date in tracks.dates]
    dates_of: dict[int, list[tuple[int, int]]] = {}
    for row in tracks.rows:
        if row.leaf is not None:
            dates_of.setdefault(row.track, []).append((row.date, row.leaf))
    numbers_of: dict[str, dict[int, dict[int, Number]]] = {
        trait: {
            track: {date: numbers[date][leaf][trait] for date, leaf in observations if trait in numbers[date][leaf]}
            for track, observations in sorted(dates_of.items())
        }
        for trait in TRAITS
    }
    points: list[GrowthPoint] = []
    curves = []
    for track, trait in product(sorted(dates_of), TRAITS):
        by_date = numbers_of[trait][track]
        times = np.array([tracks.dates[date].time for date in by_date])
        values = np.array([number.value for number in by_date.values()])
        sds = np.array([number.sd for number in by_date.values()])
        for place, (date, number) in enumerate(by_date.items()):
            near = slice(max(place - 1, 0), place + 2)
            is_told = place > 0 or len(by_date) > 2
            rates = slope(times[near], values[near], sds[near]) if is_told else (math.nan, math.nan)
            points.append(GrowthPoint(track, trait, date, number, *rates))
        if trait in SIZES and len(by_date) >= GROWTH.least_dates:
            curves.append(fit_curve(track, trait, (times, values, sds)))
    return Growth(tuple(points), tuple(curves), tuple(_plant_rows(tracks, points)))


def slope(times: Floats, values: Floats, sds: Floats) -> tuple[float, float]:
    """The slope of the straight line through two or three values, weighted by their certainty, and its standard
    deviation; NaN for fewer, and where the values have none."""
    if len(times) < 2:
        return math.nan, math.nan
    is_known = bool((np.isfinite(sds) & (sds > 0)).all())
    line, covariance = np.polyfit(times - times.mean(), values, 1, w=1 / sds if is_known else None, cov="unscaled")
    return float(line[0]), math.sqrt(covariance[0, 0]) if is_known else math.nan


def fit_curve(track: int, trait: str, sizes: tuple[Floats, Floats, Floats]) -> GrowthCurve:
    """The model with the least Akaike criterion through (times, values, sds); robust against single dates."""
    times, values, sds = sizes
    sds = np.maximum(np.where(np.isfinite(sds), sds, GROWTH.guessed_sd * values), GROWTH.least_sd * values)
    fits = [_fit(track, trait, model, (times, values, sds)) for model in CURVES]
    return min(fits, key=lambda fit: fit.criterion)


def _plant_rows(tracks: Tracks, points: Sequence[GrowthPoint]) -> Iterator[PlantRow]:
    areas: dict[int, dict[int, Number]] = {}
    for point in points:
        if point.trait == "area":
            areas.setdefault(point.date, {})[point.track] = point.number
    states, total_born = Counter((row.date, row.state) for row in tracks.rows), 0
    for index, date in enumerate(tracks.dates):
        total_born += states[index, "born"]
        days = date.time - tracks.dates[max(index - 1, 0)].time
        yield PlantRow(
            date=index,
            leaves=len(date.leaves),
            born=states[index, "born"],
            gone=states[index, "gone"],
            phyllochron=(date.time - tracks.dates[0].time) / total_born if total_born else math.nan,
            total_area=date.whole.get("total_leaf_area", NOTHING),
            relative_growth_rate=_relative_growth(areas.get(index - 1, {}), areas.get(index, {}), days),
        )


def _relative_growth(before: Mapping[int, Number], now: Mapping[int, Number], days: float) -> Number:
    """Relative growth rate of the tracks that are measured on both dates."""
    both = before.keys() & now.keys()
    if not both:
        return NOTHING
    sums = [sum(numbers[track].value for track in both) for numbers in (before, now)]
    errors = [math.hypot(*(numbers[track].sd for track in both)) for numbers in (before, now)]
    sd = math.hypot(errors[0] / sums[0], errors[1] / sums[1])
    return Number(math.log(sums[1] / sums[0]) / days, sd / days, "1/day")


# {model: the sizes at times (T,) by its parameters}, see `GrowthCurve`
CURVES: dict[str, Callable[[Sequence[float], Floats], Floats]] = {
    "constant": lambda p, times: np.full(len(times), p[0]),
    "logistic": lambda p, times: p[0] * np.asarray(expit(p[1] * (times - p[2]))),
    "expolinear": lambda p, times: p[0] / p[1] * np.logaddexp(0, p[1] * (times - p[2])),
}


def _fit(track: int, trait: str, model: str, sizes: tuple[Floats, Floats, Floats]) -> GrowthCurve:
    """One model through (times, values, sds), from two starts."""
    times, values, sds = sizes
    span, largest, shape = times[-1] - times[0], float(values.max()), CURVES[model]
    count = 1 if model == "constant" else 3
    steady = largest if model != "expolinear" else max(float(np.ptp(values)), GROWTH.least_growth * largest) / span
    (smallest, largest_size), (slowest, fastest) = GROWTH.sizes, GROWTH.rates
    least = [smallest * steady, slowest / span, times[0] - GROWTH.before * span]
    most = [largest_size * steady, fastest / span, times[-1] + span]
    fits = [
        least_squares(
            lambda p: (shape(p, times) - values) / sds, (steady, GROWTH.first_rate / span, middle)[:count],
            loss="soft_l1", bounds=(least[:count], most[:count]), x_scale=(steady, 1 / span, span)[:count],
        )
        for middle in [times[0] + share * span for share in GROWTH.middles]
    ]  # fmt: skip
    best = min(fits, key=lambda fit: float(fit.cost))
    information, parameters, errors = best.jac.T @ best.jac, np.full(3, np.nan), np.full(3, np.nan)
    parameters[:count] = best.x
    if np.linalg.cond(information) < GROWTH.most_condition:
        errors[:count] = np.sqrt(np.maximum(np.diag(np.linalg.inv(information)), 0))
    residual = float(np.sqrt(np.mean(np.square((shape(best.x, times) - values) / sds))))
    return GrowthCurve(
        track=track, trait=trait, model=model, parameters=tuple(parameters.tolist()), sds=tuple(errors.tolist()),
        residual=residual, criterion=2 * float(best.cost) + 2 * count,
    )  # fmt: skip
