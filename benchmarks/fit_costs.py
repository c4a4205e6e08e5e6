"""How much do leaves change between dates? `python benchmarks/fit_costs.py SERIES.csv RESULTS`

The table and the results of real seedlings are those of `benchmarks/tracking.py results`; beside them, simulated plants
of 2 to 9 leaves (SMALL) and two of 12 to 30. Dates at most three apart are put into the pose that fits their true
pairs.
Of each leaf, that it goes with its like on the other date, or with none, against all others, is made likeliest:
exp(-cost) against 1 and the sum of exp(-cost) over the others. Prints `POSES` and `LINKS` of
`mvseg/tracking/fitted_costs.py`; and for each species of SERIES.csv (plant names begin with it) the loss per leaf, and
short and long of its plants as `benchmarks/tracking.py` has them, with scales that were fitted without it.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.tracking import Labels, labels_of, measure, read_series, see_series
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.series import SeriesSpec, draw_specs
from mvseg.tracking.align import _fit
from mvseg.tracking.compare import MOST_GAP
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.fitted_costs import LINKS, POSES, Scales, fitted_costs
from mvseg.tracking.leaves import Pair, leaves_of
from mvseg.tracking.track import track_leaves

SMALL, RIDGE = 16, 3e-3
Known = tuple[Pair, np.ndarray, np.ndarray]  # in one frame, and the true ids of either date


def small_specs() -> list[SeriesSpec]:
    """Plants of few leaves, each 1, 2 or 3 days."""
    rng, families = np.random.default_rng(7), list(FAMILIES)
    drawn = [(rng.integers(2, 6), rng.integers(1, 5), rng.choice([1, 2, 3])) for _ in range(SMALL)]
    return [
        SeriesSpec(name=f"small{n}", family=families[n % len(families)], leaves=(int(first), int(new)),
                   times=tuple(float(step * day) for day in range(8)), seed=7000 + n)
        for n, (first, new, step) in enumerate(drawn)
    ]  # fmt: skip


def known_pairs(dates: list[PlantOnDate], truth: Labels) -> list[Known]:
    """All pairs of dates that share leaves, of leaves whose true id is known, where they truly stand."""
    leaves = [leaves_of(date) for date in dates]
    true = [np.array(ids, int)[each.index] for ids, each in zip(truth, leaves, strict=True)]
    found = []
    for later in range(len(dates)):
        for earlier in range(max(0, later - MOST_GAP), later):
            one, other = (np.flatnonzero(true[date] > 0) for date in (earlier, later))
            ids = true[earlier][one], true[later][other]
            days = dates[later].time - dates[earlier].time
            pair = Pair.of(leaves[earlier].take(one), leaves[later].take(other), days=days, knows_up=True)
            pairs = np.argwhere(ids[0][:, None] == ids[1])
            if len(pairs):
                found.append((pair.moved(_true_pose(pair, pairs)), *ids))
    return found


def _true_pose(pair: Pair, pairs: np.ndarray) -> np.ndarray:
    """(4, 4); of fewer than three pairs, that it stood as it stood, unless they are a leaf's length away."""
    pose, same = np.eye(4), np.ones(len(pairs))
    for _ in range(2):
        pose = _fit(pair, pairs, same, start=pose[:3, :3])
    one, other = pair.first.midribs[pairs[:, 0]].mean(1), pair.second.midribs[pairs[:, 1]].mean(1)
    stood = np.median(np.linalg.norm(one - other, axis=1)) <= pair.scale
    return np.eye(4) if len(pairs) < 3 and stood else pose


def loss(known: list[Known], scales: Scales) -> tuple[float, int]:
    """Of all leaves, and their number."""
    total, count = 0.0, 0
    for pair, one, other in known:
        odds = -np.clip(fitted_costs(pair, scales), -50, 50)
        total += np.log1p(np.exp(odds).sum(0)).sum() + np.log1p(np.exp(odds).sum(1)).sum()
        total -= 2 * odds[one[:, None] == other].sum()
        count += len(one) + len(other)
    return total, count


def fit(groups: list[tuple[float, list[Known]]], start: Scales) -> Scales:
    """Scales of the least sum of weighted losses per leaf; a weak prior keeps their logarithms near the start."""
    names = [name for name in asdict(start) if start.lines or name not in ("lines", "near")]
    first = np.log([getattr(start, name) for name in names])

    def unpack(x: np.ndarray) -> Scales:
        return Scales(**{**asdict(start), **dict(zip(names, np.exp(x).tolist(), strict=True))})

    def objective(x: np.ndarray) -> float:
        sums = ((weight, loss(known, unpack(x))) for weight, known in groups)
        return sum(weight * total / count for weight, (total, count) in sums) + RIDGE * float(((x - first) ** 2).sum())

    return unpack(minimize(objective, first, method="L-BFGS-B", options={"maxiter": 60}).x)


def track_with(series: tuple[list[PlantOnDate], Labels], poses: Scales, links: Scales) -> tuple[float, float]:
    """Short and long of one plant, linked with other scales."""
    dates, truth = series
    costs = partial(_other_costs, poses=poses, links=links)
    with (
        patch("mvseg.tracking.align.fitted_costs", costs),
        patch("mvseg.tracking.place_dates.fitted_costs", costs),
        patch("mvseg.tracking.compare.fitted_costs", costs),
    ):
        found = measure(truth, labels_of(track_leaves(dates)))
    return found["short"], found["long"]


def _other_costs(pair: Pair, scales: Scales = POSES, *, poses: Scales, links: Scales) -> np.ndarray:
    return fitted_costs(pair, links if scales is LINKS else poses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("results", type=Path)
    args = parser.parse_args()
    series = read_series(args.table, args.results)
    real = {plant: known_pairs(*each) for plant, each in series.items()}
    simulated = [[pair for spec in specs for pair in known_pairs(*see_series(spec))]
                 for specs in (draw_specs(2, seed=0), small_specs())]  # fmt: skip
    species = sorted({plant.split("_")[0] for plant in real})
    for left_out in ("", *species):
        own = [plant for plant in real if plant.split("_")[0] == left_out]
        known = [pair for plant, pairs in real.items() if plant not in own for pair in pairs]
        groups = [(1.0, known), *((0.5, each) for each in simulated)]
        poses, links = fit(groups, POSES), fit(groups, LINKS)
        if not own:
            for name, scales in (("POSES", poses), ("LINKS", links)):
                print(name, "=", {key: round(value, 3) for key, value in asdict(scales).items()}, flush=True)
            continue
        losses = [loss([pair for plant in own for pair in real[plant]], scales) for scales in (poses, links)]
        said = ", ".join(f"{total / count:.3f}" for total, count in losses)
        short, long = np.mean([track_with(series[plant], poses, links) for plant in own], 0)
        print(f"without {left_out}: loss per leaf {said}; {len(own)} plants, {short:.3f} / {long:.3f}", flush=True)


if __name__ == "__main__":
    main()
