"""Growth: curves and rates of each leaf, and what the plant as a whole does from date to date.

Standard deviations are those of the surfaces, carried through; errors of different dates count as independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from mvseg.tracking.dates import Floats, Number
from mvseg.tracking.track import Tracks

TRAITS = ("area", "length", "width", "inclination", "curvature", "insertion_height", "greenness_index")
SIZES = ("area", "length", "width")  # get a curve, too
LEAST_SD = 0.01  # of a size, as a share of it: no leaf is measured better
LEAST_DATES = 5  # for a curve of growth
NOTHING = Number(math.nan, math.nan, "")


@dataclass(frozen=True)
class GrowthPoint:
    """One trait of one leaf on one date; `rate` per day is the slope through this date and its neighbours."""

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
        size: K; of the expolinear curve the rate c of its linear growth.
        rate: r, per day; NaN of a constant.
        middle: t0, days; NaN of a constant.
        sds: standard deviations of these three; NaN where the dates do not tell them.
        residual: root mean square of what is left, in standard deviations of the sizes.
    """

    track: int
    trait: str
    model: str
    size: float
    rate: float
    middle: float
    sds: tuple[float, float, float]
    residual: float

    def at(self, times: Floats) -> Floats:
        """The sizes at times (T,)."""
        curve: Floats = _CURVES[self.model](np.array([self.size, self.rate, self.middle]), times)
        return curve


@dataclass(frozen=True)
class PlantRow:
    """The plant on one date; NaN where there is no number.

    Attributes:
        date: index into `Tracks.dates`.
        leaves, born, gone: numbers of leaves, and of those that appeared or went since the date before.
        phyllochron: days per leaf that appeared, since the first date.
        total_area: with its standard deviation.
        relative_growth_rate: of the area of those leaves that are measured on this date and the one before, per day,
            with its standard deviation.
        divergence: degrees between the azimuths of leaves that follow each other up the stem, in [0, 180].
    """

    date: int
    leaves: int
    born: int
    gone: int
    phyllochron: float
    total_area: Number
    relative_growth_rate: Number
    divergence: tuple[float, ...]


def growth_points(tracks: Tracks) -> list[GrowthPoint]:
    """All traits of all tracks on the dates on which they were measured, by track, trait and time."""
    points = []
    found = _series(tracks)
    for track, trait in sorted(found, key=lambda key: (key[0], TRAITS.index(key[1]))):
        series = found[track, trait]
        times = np.array([tracks.dates[date].time for date, _ in series])
        values = np.array([number.value for _, number in series])
        sds = np.array([number.sd for _, number in series])
        for place, (date, number) in enumerate(series):
            near = slice(max(place - 1, 0), place + 2)
            rate, rate_sd = slope(times[near], values[near], sds[near])
            points.append(GrowthPoint(track, trait, date, number, rate, rate_sd))
    return points


def slope(times: Floats, values: Floats, sds: Floats) -> tuple[float, float]:
    """The slope of the straight line through two or three values, weighted by their certainty, and its standard
    deviation; NaN for fewer, and where the values have none."""
    if len(times) < 2:
        return math.nan, math.nan
    known = np.isfinite(sds) & (sds > 0)
    weights = 1 / np.square(sds) if known.all() else np.ones(len(times))
    away = times - weights @ times / weights.sum()
    spread = float(weights @ away**2)
    return float((weights * away) @ values / spread), (1 / math.sqrt(spread) if known.all() else math.nan)


def fit_curves(tracks: Tracks) -> list[GrowthCurve]:
    """For each size with LEAST_DATES dates or more, the model with the least Akaike criterion."""
    curves = []
    for (track, trait), series in sorted(_series(tracks).items()):
        if trait in SIZES and len(series) >= LEAST_DATES:
            times = np.array([tracks.dates[date].time for date, _ in series])
            values = np.array([number.value for _, number in series])
            sds = np.array([number.sd if math.isfinite(number.sd) else 0.05 * number.value for _, number in series])
            sds = np.maximum(sds, LEAST_SD * values)
            fits = [_fit(track, trait, model, (times, values, sds)) for model in _CURVES]
            curves.append(min(fits, key=lambda fit: fit[0])[1])
    return curves


def plant_rows(tracks: Tracks) -> list[PlantRow]:
    """One row per date."""
    areas: dict[int, dict[int, Number]] = {}
    for (track, trait), series in _series(tracks).items():
        if trait == "area":
            for index, number in series:
                areas.setdefault(index, {})[track] = number
    rows, total_born = [], 0
    for index, date in enumerate(tracks.dates):
        born = sum(row.date == index and row.state == "born" for row in tracks.rows)
        total_born += born
        days = date.time - tracks.dates[0].time
        rows.append(
            PlantRow(
                date=index,
                leaves=len(date.leaves),
                born=born,
                gone=sum(row.date == index and row.state == "gone" for row in tracks.rows),
                phyllochron=days / total_born if total_born else math.nan,
                total_area=date.whole.get("total_leaf_area", NOTHING),
                relative_growth_rate=_relative_growth(tracks, areas, index),
                divergence=_divergence(tracks, index) if date.knows_up else (),
            )
        )
    return rows


def _series(tracks: Tracks) -> dict[tuple[int, str], list[tuple[int, Number]]]:
    """{(track, trait): [(date, number), ...]} in the order of time."""
    series: dict[tuple[int, str], list[tuple[int, Number]]] = {}
    numbers = [{leaf.leaf: leaf.numbers for leaf in date.leaves} for date in tracks.dates]
    for row in tracks.rows:
        if row.leaf is not None:
            for trait in TRAITS:
                if trait in numbers[row.date][row.leaf]:
                    series.setdefault((row.track, trait), []).append((row.date, numbers[row.date][row.leaf][trait]))
    return series


def _relative_growth(tracks: Tracks, areas: dict[int, dict[int, Number]], date: int) -> Number:
    before, now = areas.get(date - 1, {}), areas.get(date, {})
    both = before.keys() & now.keys()
    if not both:
        return NOTHING
    days = tracks.dates[date].time - tracks.dates[date - 1].time
    sums, variances = [], []
    for numbers in (before, now):
        total = sum(numbers[track].value for track in both)
        sums.append(total)
        variances.append(sum(numbers[track].sd ** 2 for track in both) / total**2)
    return Number(math.log(sums[1] / sums[0]) / days, math.sqrt(sum(variances)) / days, "1/day")


def _divergence(tracks: Tracks, date: int) -> tuple[float, ...]:
    leaves = [
        (leaf.numbers["insertion_height"].value, leaf.numbers["azimuth"].value)
        for leaf in tracks.dates[date].leaves
        if {"insertion_height", "azimuth"} <= leaf.numbers.keys()
    ]
    turns = [abs((upper - lower + 180) % 360 - 180) for (_, lower), (_, upper) in pairwise(sorted(leaves))]
    return tuple(round(turn, 1) for turn in turns)


def _logistic(parameters: Floats, times: Floats) -> Floats:
    size, rate, middle = parameters
    return np.asarray(size / (1 + np.exp(-np.clip(rate * (times - middle), -50, 50))))


def _expolinear(parameters: Floats, times: Floats) -> Floats:
    size, rate, middle = parameters
    return np.asarray(size / rate * np.logaddexp(0, np.clip(rate * (times - middle), -50, 500)))


def _constant(parameters: Floats, times: Floats) -> Floats:
    return np.full(len(times), parameters[0])


_CURVES = {"constant": _constant, "logistic": _logistic, "expolinear": _expolinear}


def _fit(track: int, trait: str, model: str, seen: tuple[Floats, Floats, Floats]) -> tuple[float, GrowthCurve]:
    """Akaike's criterion and the curve of one model through (times, values, sds); robust against single dates."""
    times, values, sds = seen
    span, largest, shape = times[-1] - times[0], float(values.max()), _CURVES[model]
    count = 1 if model == "constant" else 3
    steady = largest if model != "expolinear" else max(float(np.ptp(values)), 0.02 * largest) / span
    least, most = [1e-3 * steady, 0.02 / span, times[0] - 5 * span], [50 * steady, 60 / span, times[-1] + span]
    fits = [
        least_squares(
            lambda p: (shape(p, times) - values) / sds, (steady, 4 / span, middle)[:count], loss="soft_l1",
            bounds=(least[:count], most[:count]), x_scale=(steady, 1 / span, span)[:count],
        )
        for middle in (times[0] - 0.5 * span, times[0] + 0.2 * span)
    ]  # fmt: skip
    best = min(fits, key=lambda fit: float(fit.cost))
    information, errors = best.jac.T @ best.jac, np.full(3, np.nan)
    if np.linalg.cond(information) < 1e14:
        errors[:count] = np.sqrt(np.maximum(np.diag(np.linalg.inv(information)), 0))
    size, rate, middle = [*best.x.tolist(), math.nan, math.nan][:3]
    residual = float(np.sqrt(np.mean(np.square((shape(best.x, times) - values) / sds))))
    sd, rate_sd, middle_sd = errors.tolist()
    curve = GrowthCurve(
        track=track, trait=trait, model=model, size=size, rate=rate, middle=middle,
        sds=(sd, rate_sd, middle_sd), residual=residual,
    )  # fmt: skip
    return 2 * float(best.cost) + 2 * count, curve
