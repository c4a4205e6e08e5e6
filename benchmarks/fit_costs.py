"""How much do leaves change between dates? `python -m benchmarks.fit_costs TABLE RESULTS [TABLE RESULTS ...]`

Tables and results of real plants are those of `benchmarks/tracking.py results`, that with the most leaves first; beside
them, simulated plants of 2 to 9 leaves (SMALL) and two of 12 to 30. Dates at most three apart are put into the pose
that fits their true pairs; for `LINKS`, they are then bent as these say.
Of each leaf, that it goes with its like on the other date, or with none, against all others, is made likeliest:
exp(-cost) against 1 and the sum of exp(-cost) over the others. Each table, and either kind of simulated plants, counts
by the root of how many leaves it has. Scales of places stay as they are but with --places-too. Prints `POSES` and
`LINKS` of `mvseg/tracking/fitted_costs.py`; and for each species of the first table (plant names begin with it) and
each other table the loss per leaf, and short and long of its plants as `benchmarks/tracking.py` has them, with scales
that were fitted without it.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize

from benchmarks.tracking import Labels, labels_of, measure, read_places, see_series
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.series import SeriesSpec, draw_specs
from mvseg.tracking.align import _fit
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.fitted_costs import LINKS, POSES, Differences, Scales, bend, costs_of, fitted_costs
from mvseg.tracking.leaves import Pair, leaves_of
from mvseg.tracking.numbers import LINKING
from mvseg.tracking.track import track_leaves

SMALL, RIDGE = 16, 3e-3
SIZES, CLOUD = ("growth", "grown", "size", "spurt", "loose", "parting"), ("cloud", "near")
Series = dict[str, tuple[list[PlantOnDate], Labels]]
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
    knows_up, found = all(date.knows_up for date in dates), []
    for later in range(len(dates)):
        for earlier in range(max(0, later - LINKING.most_gap), later):
            one, other = (np.flatnonzero(true[date] > 0) for date in (earlier, later))
            ids = true[earlier][one], true[later][other]
            days = dates[later].time - dates[earlier].time
            pair = Pair.of(leaves[earlier].select(one), leaves[later].select(other), days=days, knows_up=knows_up)
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


@dataclass(frozen=True, eq=False)
class Joined:
    """Pairs of leaves of many pairs of dates, one after another.

    Attributes:
        found: of each pair.
        rows, columns: of each pair, the earlier and the later leaf, counted through all dates.
        is_same: of each pair.
        count: leaves.
    """

    found: Differences
    rows: np.ndarray
    columns: np.ndarray
    is_same: np.ndarray
    count: int


def join(known: list[Known], *, is_bent: bool) -> Joined:
    each = []
    for pair, one, other in known:
        first, widths = bend(pair, np.argwhere(one[:, None] == other)) if is_bent else (pair.first, None)
        each.append(Differences.of(replace(pair, first=first), widths, cloud=True))
    parts = {field.name: [getattr(one, field.name) for one in each] for field in fields(Differences)}
    flat = {name: np.concatenate([part.reshape(*part.shape[:-2], -1) for part in of], -1) for name, of in parts.items()}
    starts = np.cumsum([(0, 0), *((len(one), len(other)) for _, one, other in known)], axis=0)
    places = [np.indices((len(one), len(other))).reshape(2, -1) + start[:, None]
              for (_, one, other), start in zip(known, starts[:-1], strict=True)]  # fmt: skip
    rows, columns = np.concatenate(places, axis=1)
    same = np.concatenate([(one[:, None] == other).ravel() for _, one, other in known])
    return Joined(Differences(**flat), rows, columns, same, int(starts[-1].sum()))


def loss(known: Joined, scales: Scales) -> float:
    """Per leaf."""
    odds = -np.clip(costs_of(known.found, scales), -50, 50)
    total = sum(np.log1p(np.bincount(side, np.exp(odds))).sum() for side in (known.rows, known.columns))
    return float(total - 2 * odds[known.is_same].sum()) / known.count


def fit(groups: list[Joined], start: Scales, *, places: bool = False) -> Scales:
    """Scales of the least sum of weighted losses per leaf; a weak prior keeps their logarithms near the start.
    `places`: those of places, too."""
    most = max(each.count for each in groups)
    weighted = [((each.count / most) ** 0.5, each) for each in groups]
    names = [name for name in asdict(start) if name in SIZES or (places and (start.cloud or name not in CLOUD))]
    first = np.log([getattr(start, name) for name in names])

    def unpack(x: np.ndarray) -> Scales:
        return Scales(**{**asdict(start), **dict(zip(names, np.exp(x).tolist(), strict=True))})

    def objective(x: np.ndarray) -> float:
        return sum(w * loss(each, unpack(x)) for w, each in weighted) + RIDGE * float(((x - first) ** 2).sum())

    return unpack(minimize(objective, first, method="L-BFGS-B", options={"maxiter": 60}).x)


def track_with(series: tuple[list[PlantOnDate], Labels], poses: Scales, links: Scales) -> tuple[float, float]:
    """Short and long of one plant, linked with other scales."""
    dates, truth = series
    costs = partial(_other_costs, poses=poses, links=links)
    with (
        patch("mvseg.tracking.align.fitted_costs", costs),
        patch("mvseg.tracking.compare.fitted_costs", costs),
        patch("mvseg.tracking.fitted_costs.fitted_costs", costs),
    ):
        found = measure(truth, labels_of(track_leaves(dates), dates))
    return found["short"], found["long"]


def _other_costs(
    pair: Pair, scales: Scales = POSES, widths: np.ndarray | None = None, *, poses: Scales, links: Scales
) -> np.ndarray:
    return fitted_costs(pair, links if scales is LINKS else poses, widths)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", type=Path, nargs="+", help="TABLE RESULTS ...")
    parser.add_argument("--places-too", action="store_true", help="fit the scales of places and directions, too")
    args = parser.parse_args()
    first, *rest = (series for series in read_places(args.places).values())
    parts: dict[str, Series] = {}  # what is left out in turn
    for plant, seen in first.items():
        parts.setdefault(plant.split("_")[0], {})[plant] = seen
    num_species = len(parts)
    parts |= {" ".join(series): series for series in rest}
    known = {name: [pair for seen in series.values() for pair in known_pairs(*seen)] for name, series in parts.items()}
    simulated = [[pair for spec in specs for pair in known_pairs(*see_series(spec))]
                 for specs in (draw_specs(2, seed=0), small_specs())]  # fmt: skip
    for left_out in ("", *parts):
        species = [pair for name in list(parts)[:num_species] if name != left_out for pair in known[name]]
        others = [known[name] for name in list(parts)[num_species:] if name != left_out]
        poses, links = (
            fit([join(group, is_bent=start is LINKS) for group in (species, *simulated, *others)], start,
                places=args.places_too)
            for start in (POSES, LINKS)
        )  # fmt: skip
        if not left_out:
            for name, scales in (("POSES", poses), ("LINKS", links)):
                print(name, "=", {key: round(value, 3) for key, value in asdict(scales).items()}, flush=True)
            continue
        said = ", ".join(f"{loss(join(known[left_out], is_bent=bent), scales):.3f}"
                         for bent, scales in ((False, poses), (True, links)))  # fmt: skip
        short, long = np.mean([track_with(seen, poses, links) for seen in parts[left_out].values()], 0)
        plants = f"{len(parts[left_out])} plants, {short:.3f} / {long:.3f}"
        print(f"without {left_out}: loss per leaf {said}; {plants}", flush=True)


if __name__ == "__main__":
    main()
