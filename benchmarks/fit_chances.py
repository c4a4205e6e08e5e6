"""How often is a pose right, and how often a link? `python -m benchmarks.fit_chances TABLE RESULTS [...]`

Tables and results of real plants are those of `benchmarks/tracking.py results`; beside them, simulated plants
of few leaves and of 12 to 30. Of two dates at most three apart, a pose is right where more than half of the leaves that
it pairs are the same. Prints, each of greatest likelihood,

- `ALIGN.temper` of `mvseg/tracking/numbers.py`, by the poses of two dates alone: that a right one is taken among all;
- `GUESS` of `mvseg/tracking/align.py`, by the poses of all dates placed together; beside them 60 pairs of dates of
  different plants of each kind, where no pose is right: they are rare, but must be noticed;
- `CALIBRATION` of `mvseg/tracking/associate.py`, by links, with the chances of poses as they are in the code.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit, logsumexp

from benchmarks.fit_costs import small_specs
from benchmarks.tracking import read_places, see_series
from mvseg.simulation.series import draw_specs
from mvseg.tracking.align import Alignment, Poses, list_poses, pose_odds, refine_alignment
from mvseg.tracking.associate import link_leaves
from mvseg.tracking.compare import compare_dates
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.leaves import DateLeaves, Pair, leaves_of
from mvseg.tracking.numbers import ALIGN, LINKING
from mvseg.tracking.place_dates import place_dates

NUM_OTHER, RIDGE, EPS = 60, 0.01, 1e-6
Dated = tuple[PlantOnDate, list[int]]
Looked = dict[tuple[int, int], Poses]
Placed = tuple[float, int, bool]  # gain of the pose, number of leaves, whether the pose is right
Seen = tuple[list[DateLeaves], list[np.ndarray], list[float], bool]  # by date: leaves, true ids, days; knows up


def see(plant: list[Dated]) -> Seen:
    leaves = [leaves_of(date) for date, _ in plant]
    true = [np.array(ids, int)[each.index] for (_, ids), each in zip(plant, leaves, strict=True)]
    return leaves, true, [date.time for date, _ in plant], all(date.knows_up for date, _ in plant)


def look(seen: Seen) -> Looked:
    """The poses of each two dates that have leaves."""
    leaves, _, times, knows_up = seen
    pairs = {
        (earlier, later): Pair.of(leaves[earlier], leaves[later], days=abs(times[later] - times[earlier]) or 2.0,
                                  knows_up=knows_up)
        for later in range(len(leaves)) for earlier in range(max(0, later - LINKING.most_gap), later)
    }  # fmt: skip
    return {place: list_poses(pair) for place, pair in pairs.items() if pair.fewer}


def is_right(seen: Seen, place: tuple[int, int], alignment: Alignment) -> bool | None:
    """Whether more than half of the pairs are of one leaf; None where no true id is known."""
    one, other = (seen[1][date][alignment.pairs[:, side]] for side, date in enumerate(place))
    is_known = (one > 0) & (other > 0)
    return bool((one == other)[is_known].mean() > 0.5) if is_known.any() else None


def fit_temper(plants: list[tuple[Seen, Looked]]) -> float:
    choices = []
    for seen, looked in plants:
        for place, poses in looked.items():
            right = np.array([bool(is_right(seen, place, each)) for each in poses.refined])
            if right.any() and not right.all():
                by_gain = np.array([pose_odds(replace(poses.pair, still=0.0), each) for each in poses.refined])
                choices.append((by_gain / ALIGN.temper, poses.odds - by_gain, right))

    def loss(x: np.ndarray) -> float:
        odds = [(float(np.exp(x[0])) * gains + prior, right) for gains, prior, right in choices]
        return float(sum(logsumexp(each) - logsumexp(each[right]) for each, right in odds))

    return float(np.exp(minimize(loss, np.zeros(1), method="Nelder-Mead").x[0]))


def judge_placed(seen: Seen, looked: Looked, *, is_other: bool) -> list[Placed]:
    """Of each two dates, placed with all others: the gain of poses, the number of leaves, and whether the pose is
    right."""
    poses, roots, _ = place_dates(len(seen[0]), looked)
    found: list[Placed] = []
    for (earlier, later), of_pair in looked.items():
        refined = refine_alignment(of_pair.pair, np.linalg.inv(poses[later]) @ poses[earlier])
        right = False if is_other else is_right(seen, (earlier, later), refined)
        if roots[earlier] == roots[later] and len(refined.pairs) and right is not None:
            found.append((refined.gain, of_pair.pair.fewer, right))
    return found


def fit_guess(plants: list[tuple[Seen, Looked]], others: list[tuple[Seen, Looked]]) -> list[float]:
    known: list[Placed] = [each for plant in plants for each in judge_placed(*plant, is_other=False)]
    strange = [each for plant in others for each in judge_placed(*plant, is_other=True)]
    gain, leaves, right = np.array(known + strange).T
    sign = np.where(right > 0, 1, -1)

    def loss(b: np.ndarray) -> float:
        odds = b[0] + (b[1] * gain / leaves - b[2]) * np.sqrt(leaves)
        return float(np.logaddexp(0, -sign * odds).sum() + RIDGE * float(b[1:] @ b[1:]))

    return [float(each) for each in minimize(loss, np.zeros(3)).x]


def fit_calibration(groups: list[list[Seen]]) -> list[float]:
    """Slope and offset, under which what `sum_over_poses` says of links is likeliest; each group counts the same."""
    odds, sure, under_others, right, weight = np.concatenate([_list_links(group) for group in groups]).T

    def loss(b: np.ndarray) -> float:
        chance = np.clip(sure * expit(b[0] * odds + b[1]) + (1 - sure) * under_others, EPS, 1 - EPS)
        return float(-(weight * np.log(np.where(right > 0, chance, 1 - chance))).sum())

    return [float(each) for each in minimize(loss, (0.3, 3.0), method="Nelder-Mead").x]


def _list_links(plants: list[Seen]) -> np.ndarray:
    """(L, 5) log odds under the pose that was taken, its chance, that of the link under the others, whether the link is
    right, and one over their number."""
    rows = []
    for leaves, true, times, knows_up in plants:
        compared = compare_dates(leaves, times, knows_up=knows_up)
        with patch("mvseg.tracking.associate.CALIBRATION", (1.0, 0.0)):
            links = link_leaves([len(each) for each in leaves], compared.costs)
        for link in links:
            (earlier, row), (later, column) = link.before, link.after
            others = compared.otherwise.get((earlier, later))
            under_others = 0.0 if others is None else others[row, column]
            if true[earlier][row] and true[later][column]:
                odds = logit(np.clip(link.probability, 1e-15, 1 - 1e-15))
                same = true[earlier][row] == true[later][column]
                rows.append((odds, compared.trust[earlier, later], under_others, same))
    return np.column_stack([np.array(rows, float), np.full(len(rows), 1 / len(rows))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", type=Path, nargs="+", help="TABLE RESULTS ...")
    args = parser.parse_args()
    groups = [list(series.values()) for series in read_places(args.places).values()]
    groups += [[see_series(spec) for spec in specs] for specs in (small_specs(), draw_specs(4, seed=3))]
    dated: list[list[list[Dated]]] = [[list(zip(*each, strict=True)) for each in group] for group in groups]
    plants = [(seen, look(seen)) for group in dated for seen in map(see, group)]
    print("temper =", round(fit_temper(plants), 2), flush=True)
    rng, others = np.random.default_rng(0), []
    for group in [group for group in dated if len(group) > 1] * NUM_OTHER:
        one, other = (group[index] for index in rng.choice(len(group), 2, replace=False))
        seen = see([one[rng.integers(len(one))], other[rng.integers(len(other))]])
        others.append((seen, look(seen)))
    print("GUESS =", [round(each, 2) for each in fit_guess(plants, others)], flush=True)
    print(
        "CALIBRATION =",
        [round(each, 2) for each in fit_calibration([[see(plant) for plant in group] for group in dated])],
    )


if __name__ == "__main__":
    main()
