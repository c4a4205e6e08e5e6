"""How often is a pose right? `python benchmarks/pose_chances.py SERIES.csv RESULTS`

The table and the results of real seedlings are those of `benchmarks/tracking.py results`. The dates of each plant are
placed; of two at most three apart the pose is right where more than half of the leaves that it pairs are the same.
Beside them: two dates of different plants, where no pose is right, and four simulated plants. Prints `GUESS` of
`mvseg/tracking/align.py`, of greatest likelihood, other plants weighted by a tenth, as rare as they are.
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
from mvseg.tracking.align import Habit, judge, link_gain, list_poses, refine
from mvseg.tracking.associate import MOST_GAP
from mvseg.tracking.costs import Pair, leaves_of
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.place_dates import place_dates

NUM_OTHER, OTHER_WEIGHT, RIDGE = 120, 0.1, 0.01
Dated = tuple[PlantOnDate, list[int]]


def judge_plant(plant: list[Dated], *, is_other: bool) -> list[tuple[float, bool]]:
    """Of each pair of dates that is known of: gain per leaf, and whether the pose is right."""
    leaves = [leaves_of(date) for date, _ in plant]
    true = [np.array(ids)[each.index] for (_, ids), each in zip(plant, leaves, strict=True)]
    pairs = {}
    for later in range(len(plant)):
        for earlier in range(max(0, later - MOST_GAP), later):
            days = abs(plant[later][0].time - plant[earlier][0].time) or 2.0
            pairs[earlier, later] = Pair.of(leaves[earlier], leaves[later], days=days, knows_up=True)
    looked = {place: list_poses(pair) for place, pair in pairs.items() if pair.fewer}
    habit = Habit.of([judge(poses, Habit()) for poses in looked.values()], "auto")
    poses, roots, _ = place_dates(len(plant), looked, habit)
    found = []
    for (earlier, later), of_pair in looked.items():
        pose = np.linalg.inv(poses[later]) @ poses[earlier]
        refined = refine(of_pair.pair, pose)
        one, other = true[earlier][refined.pairs[:, 0]], true[later][refined.pairs[:, 1]]
        is_known = (one > 0) & (other > 0)
        if roots[earlier] == roots[later] and len(one) and (is_other or is_known.any()):
            is_right = not is_other and bool((one == other)[is_known].mean() > 0.5)
            found.append((link_gain(of_pair.pair, refined.pose) / of_pair.pair.fewer, is_right))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("results", type=Path)
    args = parser.parse_args()
    plants = [list(zip(*series, strict=True)) for series in read_series(args.table, args.results).values()]
    plants += [list(zip(*see_series(spec), strict=True)) for spec in draw_specs(4, seed=3)]
    rng, known, weights = np.random.default_rng(0), [], []
    for plant in plants:
        known += judge_plant(plant, is_other=False)
    weights += [1.0] * len(known)
    for _ in range(NUM_OTHER):
        one, other = (plants[index] for index in rng.choice(len(plants), 2, replace=False))
        known += judge_plant([one[rng.integers(len(one))], other[rng.integers(len(other))]], is_other=True)
    weights += [OTHER_WEIGHT] * (len(known) - len(weights))
    features = np.array([(1.0, gain) for gain, _ in known])
    sign, weight = np.array([1 if right else -1 for _, right in known]), np.array(weights)

    def loss(b: np.ndarray) -> float:
        return float((weight * np.logaddexp(0, -sign * (features @ b))).sum() + RIDGE * (b[1:] ** 2).sum())

    print(f"{len(known)} poses, {(sign > 0).sum()} right; GUESS =", minimize(loss, np.zeros(2)).x.round(2).tolist())


if __name__ == "__main__":
    main()
