"""How often is a guessed pose right? `python benchmarks/guessed_poses.py SERIES.csv RESULTS`

The table and the results of real seedlings are those of `benchmarks/tracking.py series`. Two dates of a plant, at most
three apart, are aligned; the pose is right where more than half of the leaves that it pairs are the same. Beside them:
dates of two different plants, where no pose is right, and four simulated plants. Prints `GUESS` of
`mvseg/tracking/align.py`, of greatest likelihood, other plants weighted by three tenths, as rare as they are.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.tracking import read_series, see_series
from mvseg.simulation.series import draw_specs
from mvseg.tracking.align import align
from mvseg.tracking.associate import MOST_GAP
from mvseg.tracking.costs import Pair, leaves_of
from mvseg.tracking.dates import PlantOnDate

NUM_OTHER, OTHER_WEIGHT, RIDGE = 120, 0.3, 0.01
Dated = tuple[PlantOnDate, list[int]]


def judge(first: Dated, second: Dated, *, is_other: bool) -> tuple[float, float, bool] | None:
    """Log odds of the pose among those looked at, gain per leaf, and whether it is right; None where nobody knows."""
    one, other = (leaves_of(date) for date, _ in (first, second))
    if not len(one) or not len(other):
        return None
    days = abs(second[0].time - first[0].time) or 2.0
    pair = Pair.of(one, other, days=days, knows_up=True)
    found = align(pair)
    if found.is_sure or not len(found.pairs):
        return None
    true, later = (np.array(ids)[leaves.index] for (_, ids), leaves in ((first, one), (second, other)))
    true, later = true[found.pairs[:, 0]], later[found.pairs[:, 1]]
    is_known = (true > 0) & (later > 0)
    if not is_other and not is_known.any():
        return None
    share = np.clip(found.share, 1e-4, 1 - 1e-4)
    is_right = not is_other and bool((true == later)[is_known].mean() > 0.5)
    return float(np.log(share / (1 - share))), found.gain / pair.fewer, is_right


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("results", type=Path)
    args = parser.parse_args()
    plants = [list(zip(*series, strict=True)) for series in read_series(args.table, args.results).values()]
    plants += [list(zip(*see_series(spec), strict=True)) for spec in draw_specs(4, seed=3)]
    rng, found, weights = np.random.default_rng(0), [], []
    for dates in plants:
        for later in range(len(dates)):
            for earlier in range(max(0, later - MOST_GAP), later):
                found.append(judge(dates[earlier], dates[later], is_other=False))
                weights.append(1.0)
    for _ in range(NUM_OTHER):
        one, other = (plants[index] for index in rng.choice(len(plants), 2, replace=False))
        found.append(judge(one[rng.integers(len(one))], other[rng.integers(len(other))], is_other=True))
        weights.append(OTHER_WEIGHT)
    known = [(*each, weight) for each, weight in zip(found, weights, strict=True) if each is not None]
    features = np.array([(1.0, odds, gain) for odds, gain, _, _ in known])
    sign, weight = np.array([1 if right else -1 for _, _, right, _ in known]), np.array([each[3] for each in known])

    def loss(b: np.ndarray) -> float:
        return float((weight * np.logaddexp(0, -sign * (features @ b))).sum() + RIDGE * (b[1:] ** 2).sum())

    print(f"{len(known)} guesses, {(sign > 0).sum()} right; GUESS =", minimize(loss, np.zeros(3)).x.round(2).tolist())


if __name__ == "__main__":
    main()
